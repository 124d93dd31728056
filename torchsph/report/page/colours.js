// Colours that people with any kind of colour vision can tell apart, and that grow evenly.
const STOPS = {
  viridis: ["#440154", "#482878", "#3e4a89", "#31688e", "#26828e", "#1f9e89", "#35b779", "#6dcd59", "#b4de2c", "#fde725"],
  balance: ["#103f78", "#2f74b3", "#7fb2d8", "#c9dfee", "#f7f7f7", "#f9d3bf", "#ee9677", "#c9473f", "#7d1125"],
  amber: ["#fff8e3", "#fde3a7", "#fbc15e", "#ee9630", "#cf6a1d", "#a3431a", "#6e2517", "#3d0f10"],
};
const SERIES = ["#0b5cad", "#c4500a", "#2b7a3d", "#7b3fa0", "#4a5561", "#a3195b"];
const TABLES = {};

/** 256 colours (256 * 3 bytes) of a scale. */
function colours(name) {
  if (!TABLES[name]) {
    const stops = STOPS[name].map((text) => [1, 3, 5].map((n) => parseInt(text.slice(n, n + 2), 16)));
    const table = new Uint8ClampedArray(768);
    for (let n = 0; n < 256; n++) {
      const place = (n / 255) * (stops.length - 1);
      const low = Math.min(Math.floor(place), stops.length - 2);
      for (let c = 0; c < 3; c++) table[3 * n + c] = stops[low][c] + (place - low) * (stops[low + 1][c] - stops[low][c]);
    }
    TABLES[name] = table;
  }
  return TABLES[name];
}

/** Which of the 256 colours a value of a channel has. */
function colourNumber(channel, value) {
  const top = topOf(channel);
  const share = CHANNELS[channel].signed ? 0.5 + (0.5 * value) / top : value / top;
  return Math.max(0, Math.min(255, Math.round(255 * share)));
}

function cssColour(channel, value) {
  const table = colours(CHANNELS[channel].colours);
  const n = 3 * colourNumber(channel, value);
  return `rgb(${table[n]},${table[n + 1]},${table[n + 2]})`;
}

/** A canvas as large as it is shown, in the screen's own pixels; returns [context, width, height] in CSS pixels. */
function fitted(canvas, height) {
  const ratio = Math.min(window.devicePixelRatio || 1, 2);
  const width = Math.max(1, canvas.clientWidth);
  const tall = Math.max(1, Math.round(height || canvas.clientHeight));
  if (height) canvas.style.height = `${tall}px`;
  const size = [Math.round(width * ratio), Math.round(tall * ratio)];
  if (canvas.width !== size[0]) canvas.width = size[0];
  if (canvas.height !== size[1]) canvas.height = size[1];
  const context = canvas.getContext("2d");
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, tall);
  return [context, width, tall];
}

const FONT = '12px system-ui, "Segoe UI", Roboto, "DejaVu Sans", Arial, sans-serif';

/** The colour scale above the planes. */
function drawScale(canvas, channel) {
  const [context, width] = fitted(canvas);
  const { label, long, unit, signed, colours: name } = CHANNELS[channel];
  const top = topOf(channel);
  const table = colours(name);
  const left = 2;
  const wide = width - 4;
  for (let n = 0; n < wide; n++) {
    const c = 3 * Math.round((255 * n) / (wide - 1));
    context.fillStyle = `rgb(${table[c]},${table[c + 1]},${table[c + 2]})`;
    context.fillRect(left + n, 16, 1.5, 12);
  }
  context.strokeStyle = "#7a8591";
  context.strokeRect(left, 16, wide, 12);
  context.font = FONT;
  context.fillStyle = "#1a1f26";
  context.fillText(`${long || label}, ${unit}`, left, 11);
  const ticks = signed ? [-top, -top / 2, 0, top / 2, top] : [0, top / 4, top / 2, (3 * top) / 4, top];
  ticks.forEach((value, n) => {
    context.textAlign = n === 0 ? "left" : n === 4 ? "right" : "center";
    context.fillText(shown(value), left + (wide * n) / 4, 41);
  });
  context.textAlign = "left";
  canvas.setAttribute("aria-label", `Colour scale: ${label}, from ${shown(ticks[0])} to ${shown(top)} ${unit}`);
}
