// The view in space: moving pathlines between the cuts of the wall.
const TAIL = 7; // kept places that a pathline shows behind its tracer

class SpaceView {
  constructor(planes, paths) {
    this.planes = planes;
    this.paths = paths;
    this.turn = [0.6, 0.25]; // about the axis, and towards the eye; radians
    this.figure = document.createElement("figure");
    const caption = document.createElement("figcaption");
    caption.textContent = planes.length > 1 ? "pathlines in space" : "pathlines";
    this.canvas = document.createElement("canvas");
    this.canvas.className = "space";
    this.canvas.tabIndex = 0;
    this.canvas.setAttribute("role", "img");
    this.reading = document.createElement("p");
    this.reading.className = "reading";
    this.reading.textContent = "Tracers carried by the analysed flow, coloured by their speed.";
    this.figure.append(caption, this.canvas, this.reading);
    if (planes.length > 1) this.listen();
    else this.turn = [0, 0];
    const [origin, across, along] = planes[0].axes;
    this.axes = [across, along, cross(across, along)];
    const [s, t] = [planes[0].corner[0], planes[0].corner[1]];
    const half = [s + 0.5 * planes[0].pixel * planes[0].size[0], t + 0.5 * planes[0].pixel * planes[0].size[1]];
    this.centre = origin.map((o, k) => o + half[0] * across[k] + half[1] * along[k]);
    // room for the body however it is turned about its axis
    const widths = planes.slice(0, 2).map((plane) => plane.pixel * plane.size[0]);
    this.reach = [Math.hypot(...widths) * 0.8, planes[0].pixel * planes[0].size[1] * 1.08];
  }

  listen() {
    let from = null;
    this.canvas.addEventListener("pointerdown", (event) => {
      from = [event.clientX, event.clientY, ...this.turn];
      this.canvas.setPointerCapture(event.pointerId);
    });
    this.canvas.addEventListener("pointermove", (event) => {
      if (!from) return;
      this.turn = [from[2] + 0.01 * (event.clientX - from[0]), clamp(from[3] + 0.01 * (event.clientY - from[1]), 1.5)];
      this.draw(this.last);
    });
    for (const name of ["pointerup", "pointercancel"]) this.canvas.addEventListener(name, () => { from = null; });
    this.canvas.addEventListener("keydown", (event) => {
      const step = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, -0.1], ArrowDown: [0, 0.1] }[event.key];
      if (!step) return;
      event.preventDefault();
      this.turn = [this.turn[0] + step[0], clamp(this.turn[1] + step[1], 1.5)];
      this.draw(this.last);
    });
  }

  /** Draw at a time (s): {time, frame, height, tracers}. */
  draw(what) {
    this.last = what;
    const [context, width, tall] = fitted(this.canvas, what.height || this.canvas.clientWidth);
    this.middle = [width / 2, tall / 2];
    this.zoom = Math.min(width / this.reach[0], tall / this.reach[1]);
    this.drawWalls(context, what.frame);
    const count = what.tracers ? this.drawTracers(context, what.time) : 0;
    this.canvas.setAttribute("aria-label", `Pathlines in space: ${count} tracers at ${shown(1e3 * what.time)} ms, the wall in outline`);
  }

  /** Screen place of a point (m), and how far towards the eye it lies. */
  project(x, y, z) {
    const d = [x - this.centre[0], y - this.centre[1], z - this.centre[2]];
    const [a, b, c] = this.axes.map((axis) => axis[0] * d[0] + axis[1] * d[1] + axis[2] * (d[2] || 0));
    const [sin, cos] = [Math.sin(this.turn[0]), Math.cos(this.turn[0])];
    const right = cos * a + sin * c;
    const depth = cos * c - sin * a;
    const up = Math.cos(this.turn[1]) * b - Math.sin(this.turn[1]) * depth;
    return [this.middle[0] + this.zoom * right, this.middle[1] - this.zoom * up, depth];
  }

  drawWalls(context, frame) {
    for (const view of this.planes.map((plane) => new Cut(plane, frame))) {
      for (const [from, to, region] of view.pieces) {
        const [x0, y0] = this.project(...from);
        const [x1, y1] = this.project(...to);
        context.strokeStyle = region ? orificeColour(region) : "rgba(60,70,82,.55)";
        context.lineWidth = region ? 3.5 : 1.4;
        context.beginPath();
        context.moveTo(x0, y0);
        context.lineTo(x1, y1);
        context.stroke();
      }
    }
  }

  drawTracers(context, time) {
    if (!this.paths) return 0;
    const { places, begins } = this.paths;
    const kept = this.paths.time;
    const [count, parts] = [places.shape[1], places.shape[2]];
    const numbers = unpacked(places);
    const anew = unpacked(begins);
    const now = Math.max(0, Math.min(kept.length - 1, positionIn(kept, time)));
    const low = Math.min(Math.floor(now), kept.length - 2);
    const share = now - low;
    const value = (k, n, c) => (c < parts ? numbers[(k * count + n) * parts + c] * places.step + places.base : 0);
    const point = (k, n) => [0, 1, 2].map((c) => value(k, n, c));
    const far = Math.max(1, TAIL);
    for (let n = 0; n < count; n++) {
      const line = [];
      const renewed = anew[(low + 1) * count + n] === 1;
      const head = renewed ? point(low, n) : point(low, n).map((x, c) => x + share * (point(low + 1, n)[c] - x));
      line.push(head);
      for (let k = low; k > Math.max(-1, low - far); k--) {
        line.push(point(k, n));
        if (anew[k * count + n]) break;
      }
      const other = renewed ? Math.max(0, low - 1) : low + 1;
      const gap = Math.abs(kept[other] - kept[low]) || 1;
      const speed = Math.hypot(...point(other, n).map((x, c) => x - point(low, n)[c])) / gap;
      const spots = line.map((p) => this.project(...p));
      context.strokeStyle = cssColour("speed", speed);
      context.lineWidth = 1.6;
      context.beginPath();
      context.moveTo(spots[0][0], spots[0][1]);
      for (const [x, y] of spots.slice(1)) context.lineTo(x, y);
      context.stroke();
      context.fillStyle = context.strokeStyle;
      context.beginPath();
      context.arc(spots[0][0], spots[0][1], 1.9, 0, 7);
      context.fill();
    }
    return count;
  }
}

/** The wall's pieces of a plane, in space. */
class Cut {
  constructor(plane, frame) {
    const [origin, across, along] = plane.axes;
    const place = (s, t) => origin.map((o, k) => o + s * across[k] + t * along[k]);
    const pieces = PlaneView.prototype.wallAt.call({ plane }, frame) || [];
    this.pieces = pieces.map(([s0, t0, s1, t1, region]) => [place(s0, t0), place(s1, t1), region]);
  }
}

const clamp = (value, most) => Math.max(-most, Math.min(most, value));

function cross(a, b) {
  if (a.length < 3) return [0, 0, 1];
  return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
}

/** Where a time lies among increasing times: 2.5 is halfway from the third to the fourth. */
function positionIn(times, time) {
  let low = 0;
  while (low < times.length - 2 && times[low + 1] <= time) low++;
  return low + (time - times[low]) / (times[low + 1] - times[low] || 1);
}
