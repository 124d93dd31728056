"use strict";
// The data of the page, and its arrays unpacked when they are first asked for.
const DATA = JSON.parse(document.getElementById("data").textContent);
const NONE = -32768; // of 16 bits: no number
const KINDS = { int16: Int16Array, uint16: Uint16Array, uint8: Uint8Array };

/** The raw numbers of a packed array; a value is number * step + base. */
function unpacked(packed) {
  if (!packed.numbers) {
    const text = atob(packed.values);
    const bytes = new Uint8Array(text.length);
    for (let n = 0; n < text.length; n++) bytes[n] = text.charCodeAt(n);
    packed.numbers = new KINDS[packed.kind](bytes.buffer);
    packed.values = null;
  }
  return packed.numbers;
}

/** One frame of a packed array (frames first), as reals. */
function frameOf(packed, frame) {
  const numbers = unpacked(packed);
  const size = packed.shape.slice(1).reduce((a, b) => a * b, 1);
  const found = new Float32Array(size);
  for (let n = 0; n < size; n++) {
    const value = numbers[frame * size + n];
    found[n] = packed.kind === "int16" && value === NONE ? NaN : value * packed.step + packed.base;
  }
  return found;
}

const CHANNELS = {
  speed: { label: "Speed", unit: "m/s", colours: "viridis", signed: false },
  vorticity: { label: "Vorticity", long: "Vorticity about the line of sight, counter-clockwise positive", unit: "1/s", colours: "balance", signed: true },
  pressure: { label: "Pressure", long: "Pressure, relative", unit: "Pa", colours: "balance", signed: true },
  deviation: { label: "Deviation", long: "Standard deviation of the velocity", unit: "m/s", colours: "amber", signed: false },
};

/** Whether a flow has a channel in its planes. */
function hasChannel(source, channel) {
  return channel === "speed" || Boolean(DATA.planes[0].fields[source][channel]);
}

/** The scalar of a channel in a plane at a frame: (nt * ns). */
function scalarOf(plane, source, channel, frame) {
  const fields = plane.fields[source];
  if (channel !== "speed") return frameOf(fields[channel], frame);
  const velocity = frameOf(fields.velocity, frame);
  const size = plane.size[0] * plane.size[1];
  const parts = velocity.length / size;
  const speed = new Float32Array(size);
  for (let n = 0; n < size; n++) {
    let square = 0;
    for (let part = 0; part < parts; part++) square += velocity[part * size + n] ** 2;
    speed[n] = Math.sqrt(square);
  }
  return speed;
}

/** The value at the far end of a channel's colours, the same for all flows. */
const TOPS = { ...DATA.tops };
function topOf(channel) {
  if (!(channel in TOPS)) {
    const first = Object.keys(DATA.planes[0].fields).find((source) => hasChannel(source, channel));
    const sizes = [];
    for (const plane of DATA.planes) {
      const packed = plane.fields[first][channel];
      const known = unpacked(plane.fields[first].known);
      const numbers = unpacked(packed);
      for (let n = 0; n < numbers.length; n += 3) if (known[n] && numbers[n] !== NONE) sizes.push(Math.abs(numbers[n]) * packed.step);
    }
    sizes.sort((a, b) => a - b);
    TOPS[channel] = sizes.length ? sizes[Math.floor(0.99 * (sizes.length - 1))] : 1;
  }
  return TOPS[channel] || 1;
}

/** A number with three digits that say something. */
function shown(value) {
  if (!Number.isFinite(value)) return "–";
  const size = Math.abs(value);
  const digits = size >= 100 || size === 0 ? 0 : size >= 10 ? 1 : size >= 1 ? 2 : size >= 0.1 ? 3 : 4;
  return value.toFixed(digits).replace("-", "−");
}
