// The page: controls, time, and what is drawn when.
const PACES = [["1/40 of real time", 1 / 40], ["1/20 of real time", 1 / 20], ["1/10 of real time", 1 / 10], ["1/4 of real time", 1 / 4], ["real time", 1]];
const byId = (id) => document.getElementById(id);
const state = { time: DATA.time[0], playing: false, last: 0, asked: false };
const planeViews = DATA.planes.map((plane, number) => new PlaneView(plane, number));
const space = DATA.paths ? new SpaceView(DATA.planes, DATA.paths) : null;
const curveViews = DATA.curves.map((curve) => new CurveView(curve, DATA.valves, goTo));

function frameAt(time) {
  return Math.max(0, Math.min(DATA.time.length - 1, DATA.time.length < 2 ? 0 : Math.round(positionIn(DATA.time, time))));
}

function goTo(time) {
  state.time = DATA.time[frameAt(time)];
  drawSoon();
}

function drawSoon() {
  if (state.asked) return;
  state.asked = true;
  requestAnimationFrame(() => { state.asked = false; drawAll(); });
}

/** The height all planes share, so that they stand side by side in one scale where they can. */
function commonHeight() {
  const tallest = Math.max(...planeViews.map((view) => (view.canvas.clientWidth * view.box[3]) / view.box[2]));
  return Math.min(tallest, Math.max(230, 0.62 * window.innerHeight));
}

function drawAll() {
  const frame = frameAt(state.time);
  const height = commonHeight();
  const what = { source: byId("source").value, channel: byId("channel").value, frame, arrows: byId("arrows").checked, height };
  const time = `${shown(1e3 * DATA.time[frame])} ms`;
  byId("time").value = String(frame);
  byId("time").setAttribute("aria-valuetext", `${time}, frame ${frame + 1} of ${DATA.time.length}`);
  byId("now").textContent = `${time}, frame ${frame + 1} of ${DATA.time.length}`;
  const drawn = JSON.stringify(what) + window.innerWidth;
  if (drawn !== state.drawn) {
    state.drawn = drawn;
    planeViews.forEach((view) => view.draw(what));
    drawScale(byId("scale"), what.channel);
    curveViews.forEach((view) => view.draw(DATA.time[frame]));
  }
  if (space) space.draw({ time: state.time, frame, height, tracers: byId("tracers").checked });
}

function tick(now) {
  if (!state.playing) return;
  const [first, last] = [DATA.time[0], DATA.time[DATA.time.length - 1]];
  state.time += Math.min(0.2, (now - state.last) / 1e3) * Number(byId("pace").value);
  if (state.time > last) state.time = first;
  state.last = now;
  drawAll();
  requestAnimationFrame(tick);
}

function play(on) {
  state.playing = on && DATA.time.length > 1;
  byId("play").textContent = state.playing ? "Pause" : "Play";
  byId("play").setAttribute("aria-pressed", String(state.playing));
  if (!state.playing) return;
  state.last = performance.now();
  requestAnimationFrame(tick);
}

function option(select, value, label) {
  const found = made("option", label);
  found.value = value;
  select.append(found);
}

/** The colours that the chosen flow has. */
function fillChannels() {
  const chosen = byId("channel").value;
  byId("channel").replaceChildren();
  for (const [name, { label }] of Object.entries(CHANNELS)) if (hasChannel(byId("source").value, name)) option(byId("channel"), name, label);
  if (chosen && hasChannel(byId("source").value, chosen)) byId("channel").value = chosen;
}

function begin() {
  DATA.about.forEach((text) => byId("about").append(made("p", text)));
  Object.keys(DATA.planes[0].fields).forEach((name) => option(byId("source"), name, name));
  fillChannels();
  PACES.forEach(([label, value]) => option(byId("pace"), value, label));
  byId("pace").value = String(1 / 20);
  byId("time").max = String(DATA.time.length - 1);
  planeViews.forEach((view) => byId("planes").append(view.figure));
  if (space) byId("planes").append(space.figure);
  else byId("tracers").closest("label").hidden = true;
  curveViews.forEach((view) => byId("curves").append(view.figure));
  byId("curves-part").hidden = !curveViews.length;
  const banded = DATA.curves.some((curve) => curve.lines.some((line) => line.low));
  byId("curves-hint").textContent = `${banded ? "Bands hold nine of ten of the members. " : ""}Shaded: open orifices, blue the first, red the second. A click goes to that time.`;
  byId("quality-part").hidden = !DATA.checks.length;
  showChecks(byId("quality"), DATA.checks);
  for (const [name, rows] of [["methods", DATA.table], ["beat", DATA.beat]]) {
    byId(`${name}-part`).hidden = !rows.length;
    if (rows.length) byId(name).append(tableOf(rows[0], rows.slice(1)));
  }
  DATA.notes.forEach((text) => byId("notes").append(made("p", text)));
  showAccount(byId("account"), DATA.account);
  byId("play").addEventListener("click", () => play(!state.playing));
  byId("time").addEventListener("input", () => { play(false); goTo(DATA.time[Number(byId("time").value)]); });
  byId("source").addEventListener("change", () => { fillChannels(); drawSoon(); });
  for (const name of ["channel", "arrows", "tracers"]) byId(name).addEventListener("change", drawSoon);
  window.addEventListener("resize", drawSoon);
  drawAll();
}

begin();
