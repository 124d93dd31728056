// One plane: its colours inside the wall, arrows, the wall itself, and the values at a point.
const ORIFICES = { 1: "#0b5cad", 2: "#b01818" };
const orificeColour = (region) => ORIFICES[region] || "#7b3fa0";

class PlaneView {
  constructor(plane, number) {
    this.plane = plane;
    this.probe = null; // [s, t], m
    this.canvas = document.createElement("canvas");
    this.canvas.tabIndex = 0;
    this.canvas.setAttribute("role", "img");
    this.reading = document.createElement("p");
    this.reading.className = "reading";
    this.reading.id = `reading-${number}`;
    this.reading.setAttribute("aria-live", "polite");
    this.canvas.setAttribute("aria-describedby", this.reading.id);
    this.figure = document.createElement("figure");
    const caption = document.createElement("figcaption");
    caption.textContent = plane.name;
    this.figure.append(caption, this.canvas, this.reading);
    this.canvas.addEventListener("pointermove", (event) => this.point(event));
    this.canvas.addEventListener("pointerdown", (event) => this.point(event));
    this.canvas.addEventListener("pointerleave", () => this.moveTo(null));
    this.canvas.addEventListener("blur", () => this.moveTo(null));
    this.canvas.addEventListener("keydown", (event) => this.key(event));
  }

  /** Extent in m: [left, bottom, width, height]. */
  get box() {
    const { pixel, corner, size } = this.plane;
    return [corner[0], corner[1], pixel * (size[0] - 1), pixel * (size[1] - 1)];
  }

  point(event) {
    const at = this.canvas.getBoundingClientRect();
    const [left, bottom] = this.box;
    this.moveTo([
      left + (event.clientX - at.left - this.shift[0]) / this.zoom,
      bottom + (at.top + this.tall - this.shift[1] - event.clientY) / this.zoom,
    ]);
  }

  key(event) {
    const step = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1] }[event.key];
    if (event.key === "Escape") this.moveTo(null);
    if (!step) return;
    event.preventDefault();
    const [left, bottom, wide, high] = this.box;
    const from = this.probe || [left + wide / 2, bottom + high / 2];
    const far = (this.plane.pixel * (event.shiftKey ? 5 : 1)) / 1;
    this.moveTo([
      Math.max(left, Math.min(left + wide, from[0] + far * step[0])),
      Math.max(bottom, Math.min(bottom + high, from[1] + far * step[1])),
    ]);
  }

  moveTo(place) {
    this.probe = place;
    if (this.last) this.draw(this.last);
  }

  /** Draw what is asked for: {source, channel, frame, arrows, height}. */
  draw(what) {
    this.last = what;
    const { plane } = this;
    const [left, bottom, wide, high] = this.box;
    const width = this.canvas.clientWidth;
    const height = what.height || (width * high) / wide;
    const [context, w, tall] = fitted(this.canvas, height);
    this.tall = tall;
    this.zoom = Math.min(w / wide, tall / high);
    this.shift = [(w - this.zoom * wide) / 2, (tall - this.zoom * high) / 2];
    this.values = scalarOf(plane, what.source, what.channel, what.frame);
    this.velocity = frameOf(plane.fields[what.source].velocity, what.frame);
    const size = plane.size[0] * plane.size[1];
    this.known = unpacked(plane.fields[what.source].known).subarray(what.frame * size, (what.frame + 1) * size);
    this.segments = this.wallAt(what.frame);
    this.paint(context, w, tall, what.channel);
    if (what.arrows) this.arrows(context);
    this.drawWall(context);
    this.drawRuler(context, w, tall);
    this.describe(what, size);
    if (this.probe) this.drawProbe(context);
  }

  x(s) { return this.shift[0] + (s - this.box[0]) * this.zoom; }
  y(t) { return this.tall - this.shift[1] - (t - this.box[1]) * this.zoom; }

  /** Pieces of the wall at a frame: [s0, t0, s1, t1, region], or null without a wall. */
  wallAt(frame) {
    const { outline } = this.plane;
    if (!outline) return null;
    const numbers = unpacked(outline.places);
    const region = unpacked(outline.region);
    const { step, base } = outline.places;
    const found = [];
    for (let n = outline.first[frame]; n < outline.first[frame + 1]; n++) {
      const place = [0, 1, 2, 3].map((k) => numbers[4 * n + k] * step + base);
      found.push([...place, region[n]]);
    }
    return found;
  }

  /** Where the blood is along a row at t (m): pairs of s, by the even-odd rule. */
  spans(t) {
    const crossings = [];
    for (const [s0, t0, s1, t1] of this.segments) {
      if (t0 > t !== t1 > t) crossings.push(s0 + ((t - t0) / (t1 - t0)) * (s1 - s0));
    }
    return crossings.sort((a, b) => a - b);
  }

  /** Colours of the screen's pixels, interpolated between the points of the plane. */
  paint(context, w, tall, channel) {
    const { width, height } = this.canvas;
    const image = context.createImageData(width, height);
    const table = colours(CHANNELS[channel].colours);
    const ratio = width / w;
    const [ns, nt] = this.plane.size;
    const [left, bottom] = this.box;
    for (let row = 0; row < height; row++) {
      const t = bottom + (tall - this.shift[1] - (row + 0.5) / ratio) / this.zoom;
      const v = (t - bottom) / this.plane.pixel;
      if (v < 0 || v > nt - 1) continue;
      const j = Math.min(Math.floor(v), nt - 2);
      const fv = v - j;
      const ends = this.segments ? this.spans(t) : null;
      let next = 0;
      let inside = !ends;
      for (let column = 0; column < width; column++) {
        const s = left + ((column + 0.5) / ratio - this.shift[0]) / this.zoom;
        while (ends && next < ends.length && ends[next] < s) { inside = !inside; next++; }
        const u = (s - left) / this.plane.pixel;
        if (!inside || u < 0 || u > ns - 1) continue;
        const i = Math.min(Math.floor(u), ns - 2);
        const fu = u - i;
        const n = j * ns + i;
        if (!this.known[Math.round(v) * ns + Math.round(u)]) continue;
        const value = (1 - fv) * ((1 - fu) * this.values[n] + fu * this.values[n + 1])
          + fv * ((1 - fu) * this.values[n + ns] + fu * this.values[n + ns + 1]);
        const c = 3 * colourNumber(channel, value);
        const at = 4 * (row * width + column);
        image.data[at] = table[c];
        image.data[at + 1] = table[c + 1];
        image.data[at + 2] = table[c + 2];
        image.data[at + 3] = 255;
      }
    }
    context.putImageData(image, 0, 0);
  }

  /** The number of the point nearest a place, or -1 where nothing is known. */
  nearest(s, t) {
    const [ns, nt] = this.plane.size;
    const i = Math.round((s - this.box[0]) / this.plane.pixel);
    const j = Math.round((t - this.box[1]) / this.plane.pixel);
    if (i < 0 || j < 0 || i >= ns || j >= nt || !this.known[j * ns + i]) return -1;
    if (this.segments && this.spans(t).filter((x) => x < s).length % 2 === 0) return -1;
    return j * ns + i;
  }

  arrows(context) {
    const gap = Math.max(13, 0.055 * this.tall); // CSS pixels
    const longest = 1.9 * gap; // of the fastest blood; twice as fast is twice as long
    const top = topOf("speed");
    const size = this.plane.size[0] * this.plane.size[1];
    const [left, bottom, wide, high] = this.box;
    for (let t = bottom + gap / 2 / this.zoom; t < bottom + high; t += gap / this.zoom) {
      for (let s = left + gap / 2 / this.zoom; s < left + wide; s += gap / this.zoom) {
        const n = this.nearest(s, t);
        if (n < 0) continue;
        const scale = longest / top;
        const dx = scale * this.velocity[n];
        const dy = -scale * this.velocity[size + n];
        const length = Math.hypot(dx, dy);
        if (length < 2.5) continue;
        const x = this.x(s) - dx / 2;
        const y = this.y(t) - dy / 2;
        const head = Math.min(7, 0.45 * length);
        const [ux, uy] = [dx / length, dy / length];
        for (const [colour, thick] of [["rgba(16,21,27,.85)", 3.4], ["#ffffff", 1.5]]) {
          context.strokeStyle = colour;
          context.lineWidth = thick;
          context.beginPath();
          context.moveTo(x, y);
          context.lineTo(x + dx, y + dy);
          context.moveTo(x + dx - head * (ux - 0.5 * uy), y + dy - head * (uy + 0.5 * ux));
          context.lineTo(x + dx, y + dy);
          context.lineTo(x + dx - head * (ux + 0.5 * uy), y + dy - head * (uy - 0.5 * ux));
          context.stroke();
        }
      }
    }
  }

  drawWall(context) {
    if (!this.segments) return;
    for (const [s0, t0, s1, t1, region] of this.segments) {
      context.strokeStyle = region ? orificeColour(region) : "#1a1f26";
      context.lineWidth = region ? 4 : 1.8;
      context.beginPath();
      context.moveTo(this.x(s0), this.y(t0));
      context.lineTo(this.x(s1), this.y(t1));
      context.stroke();
    }
  }

  /** A bar of a round length. */
  drawRuler(context, w, tall) {
    const most = (0.35 * w) / this.zoom;
    const power = 10 ** Math.floor(Math.log10(most));
    const length = power * [5, 2, 1].find((n) => n * power <= most);
    context.fillStyle = "#1a1f26";
    context.fillRect(8, tall - 8, length * this.zoom, 3);
    context.font = FONT;
    context.fillText(`${Number((1e3 * length).toPrecision(3))} mm`, 8, tall - 13);
  }

  describe(what, size) {
    const { label, unit } = CHANNELS[what.channel];
    let largest = -Infinity;
    let least = Infinity;
    for (let n = 0; n < size; n++) {
      if (!this.known[n]) continue;
      largest = Math.max(largest, this.values[n]);
      least = Math.min(least, this.values[n]);
    }
    const range = largest >= least ? `${shown(least)} to ${shown(largest)} ${unit}` : "nothing known";
    this.canvas.setAttribute("aria-label", `${this.plane.name}, ${what.source}: ${label}, ${range}`);
    if (!this.probe) {
      this.reading.textContent = `${label}: ${range}`;
      return;
    }
    const n = this.nearest(...this.probe);
    if (n < 0) {
      this.reading.textContent = "no blood here";
      return;
    }
    const velocity = [0, 1, 2].slice(0, this.velocity.length / size).map((k) => shown(this.velocity[k * size + n]));
    const first = what.channel === "speed" ? "Speed" : label;
    this.reading.textContent = `${first} ${shown(this.values[n])} ${unit}; velocity right, up${velocity[2] ? ", towards you" : ""}: ${velocity.join(", ")} m/s`;
  }

  drawProbe(context) {
    const [x, y] = [this.x(this.probe[0]), this.y(this.probe[1])];
    for (const [colour, thick] of [["#ffffff", 4], ["#d96b00", 2]]) {
      context.strokeStyle = colour;
      context.lineWidth = thick;
      context.beginPath();
      context.arc(x, y, 6, 0, 7);
      context.stroke();
    }
  }
}
