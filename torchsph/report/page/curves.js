// Curves over time with their bands; a click goes to that time.
const EDGE = { left: 52, right: 10, top: 8, bottom: 22 };

class CurveView {
  constructor(curve, valves, goTo) {
    this.curve = curve;
    this.valves = valves;
    this.figure = document.createElement("figure");
    const title = document.createElement("h3");
    title.textContent = curve.unit ? `${curve.name}, ${curve.unit}` : curve.name;
    this.canvas = document.createElement("canvas");
    this.canvas.setAttribute("role", "img");
    this.legend = document.createElement("div");
    this.legend.className = "legend";
    this.figure.append(title, this.canvas, this.legend);
    this.span = [DATA.time[0], DATA.time[DATA.time.length - 1]];
    this.range = this.limits();
    this.canvas.setAttribute("aria-label", this.words());
    this.canvas.addEventListener("click", (event) => {
      const share = (event.clientX - this.canvas.getBoundingClientRect().left - EDGE.left) / this.wide;
      goTo(this.span[0] + Math.max(0, Math.min(1, share)) * (this.span[1] - this.span[0]));
    });
  }

  /** Least and largest value to show: bands of the curves, 0 where it is near. */
  limits() {
    const all = this.curve.lines.flatMap((line) => [line.values, line.low || [], line.high || []]).flat();
    const known = all.filter((value) => value !== null);
    let [low, high] = [Math.min(...known, Infinity), Math.max(...known, -Infinity)];
    if (!(high >= low)) return [0, 1];
    const room = 0.06 * (high - low || Math.abs(high) || 1);
    if (low >= 0 && low < 0.6 * high) return [0, high + room];
    if (high <= 0 && high > 0.6 * low) return [low - room, 0];
    return [low - room, high + room];
  }

  words() {
    const parts = this.curve.lines.map((line) => {
      const known = line.values.map((value, n) => [value, line.time[n]]).filter(([value]) => value !== null);
      if (!known.length) return `${line.label}: nothing`;
      const top = known.reduce((a, b) => (b[0] > a[0] ? b : a));
      const bottom = known.reduce((a, b) => (b[0] < a[0] ? b : a));
      return `${line.label}: highest ${shown(top[0])} at ${shown(1e3 * top[1])} ms, lowest ${shown(bottom[0])} at ${shown(1e3 * bottom[1])} ms`;
    });
    return `${this.curve.name} ${this.curve.unit} over time. ${parts.join("; ")}.`;
  }

  draw(time) {
    const [context, width, tall] = fitted(this.canvas);
    this.wide = width - EDGE.left - EDGE.right;
    const high = tall - EDGE.top - EDGE.bottom;
    const x = (t) => EDGE.left + (this.wide * (t - this.span[0])) / (this.span[1] - this.span[0] || 1);
    const y = (value) => EDGE.top + (high * (this.range[1] - value)) / (this.range[1] - this.range[0]);
    this.shade(context, x, high);
    this.axes(context, x, y, width, tall);
    context.save();
    context.beginPath();
    context.rect(EDGE.left, EDGE.top - 2, this.wide + 2, high + 4);
    context.clip();
    this.curve.lines.forEach((line, n) => band(context, line, x, y, SERIES[n % SERIES.length]));
    this.curve.lines.forEach((line, n) => stroke(context, line, x, y, SERIES[n % SERIES.length], n));
    context.restore();
    context.strokeStyle = "#d96b00";
    context.lineWidth = 1.5;
    context.beginPath();
    context.moveTo(x(time), EDGE.top);
    context.lineTo(x(time), EDGE.top + high);
    context.stroke();
    this.tell(time);
  }

  /** Where orifices are open. */
  shade(context, x, high) {
    for (const { region, opens, closes } of this.valves) {
      context.globalAlpha = 0.08;
      context.fillStyle = orificeColour(region);
      context.fillRect(x(opens), EDGE.top, x(closes) - x(opens), high);
    }
    context.globalAlpha = 1;
  }

  axes(context, x, y, width, tall) {
    context.font = FONT;
    context.lineWidth = 1;
    for (const value of roundSteps(this.range[0], this.range[1], 4)) {
      context.strokeStyle = value === 0 ? "#7a8591" : "#dde2e7";
      context.beginPath();
      context.moveTo(EDGE.left, y(value));
      context.lineTo(width - EDGE.right, y(value));
      context.stroke();
      context.fillStyle = "#39424d";
      context.textAlign = "right";
      context.fillText(Number(value.toPrecision(6)).toString().replace("-", "−"), EDGE.left - 5, y(value) + 4);
    }
    context.textAlign = "center";
    for (const ms of roundSteps(1e3 * this.span[0], 1e3 * this.span[1], Math.max(2, Math.floor(width / 90)))) {
      context.fillStyle = "#39424d";
      context.fillText(Number(ms.toPrecision(6)).toString(), x(ms / 1e3), tall - 6);
      context.strokeStyle = "#7a8591";
      context.beginPath();
      context.moveTo(x(ms / 1e3), tall - EDGE.bottom);
      context.lineTo(x(ms / 1e3), tall - EDGE.bottom + 4);
      context.stroke();
    }
    context.textAlign = "right";
    context.fillText("ms", EDGE.left - 5, tall - 6);
    context.textAlign = "left";
  }

  /** The values at a time, in the legend. */
  tell(time) {
    this.legend.replaceChildren();
    this.curve.lines.forEach((line, n) => {
      const at = Math.round(positionIn(line.time, time));
      const entry = document.createElement("span");
      const mark = document.createElement("i");
      mark.style.borderColor = SERIES[n % SERIES.length];
      mark.style.borderTopStyle = DASHES[n % DASHES.length].length ? "dashed" : "solid";
      const value = line.values[at];
      let text = `${line.label} ${value === null || value === undefined ? "–" : shown(value)}`;
      if (line.low && line.low[at] !== null) text += ` (${shown(line.low[at])} to ${shown(line.high[at])})`;
      entry.append(mark, text);
      this.legend.append(entry);
    });
  }
}

const DASHES = [[], [7, 4], [2, 3], [9, 3, 2, 3], [4, 4], [1, 4]];

function band(context, line, x, y, colour) {
  if (!line.low) return;
  const known = line.time.map((t, n) => n).filter((n) => line.low[n] !== null && line.high[n] !== null);
  if (!known.length) return;
  context.beginPath();
  known.forEach((n) => context.lineTo(x(line.time[n]), y(line.high[n])));
  known.reverse().forEach((n) => context.lineTo(x(line.time[n]), y(line.low[n])));
  context.globalAlpha = 0.18;
  context.fillStyle = colour;
  context.fill();
  context.globalAlpha = 1;
}

function stroke(context, line, x, y, colour, number) {
  context.strokeStyle = colour;
  context.lineWidth = 2;
  context.setLineDash(DASHES[number % DASHES.length]);
  context.beginPath();
  let on = false;
  line.values.forEach((value, n) => {
    if (value === null) { on = false; return; }
    if (on) context.lineTo(x(line.time[n]), y(value));
    else context.moveTo(x(line.time[n]), y(value));
    on = true;
  });
  context.stroke();
  context.setLineDash([]);
}

/** About `count` round numbers within a range. */
function roundSteps(low, high, count) {
  const rough = (high - low) / count;
  if (!(rough > 0)) return [low];
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = power * [1, 2, 5, 10].find((n) => n * power >= rough);
  const found = [];
  for (let n = Math.ceil(low / step - 1e-9); n * step <= high + 1e-9 * step; n++) found.push(n * step);
  return found;
}
