// Drawing: pictures, lines over time and bars, in the colours of the page.

const FONT = '12px system-ui, "DejaVu Sans", sans-serif';
const NOTHING = 128;

function colour(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
}

function rgb(name) {
  const hex = colour(name);
  return [1, 3, 5].map((at) => parseInt(hex.slice(at, at + 2), 16));
}

/** A cleared context in units of CSS pixels, however fine the screen is. */
function cleared(canvas) {
  const { clientWidth: width, clientHeight: height } = canvas;
  const fine = window.devicePixelRatio || 1;
  canvas.width = Math.round(width * fine);
  canvas.height = Math.round(height * fine);
  const context = canvas.getContext("2d");
  context.setTransform(fine, 0, 0, fine, 0, 0);
  context.font = FONT;
  context.textBaseline = "middle";
  return { context, width, height };
}

function say(canvas, text) {
  const { context, width, height } = cleared(canvas);
  context.fillStyle = colour("soft");
  context.textAlign = "center";
  context.fillText(text, width / 2, height / 2, width);
}

/** 256 colours: from OFF over nothing to ON. */
function signedColours() {
  const [empty, on, off] = [rgb("empty"), rgb("on"), rgb("off")];
  return Array.from({ length: 256 }, (_, value) => {
    const share = Math.min(Math.abs(value - NOTHING) / 127, 1);
    const full = value > NOTHING ? on : off;
    return empty.map((from, i) => from + (full[i] - from) * share);
  });
}

/** 256 colours: from nothing to much. */
function plainColours() {
  const [empty, full] = [rgb("empty"), rgb("accent")];
  return Array.from({ length: 256 }, (_, value) => empty.map((from, i) => from + ((full[i] - from) * value) / 255));
}

/** Columns `[first, last)` of a picture as a bitmap. */
function bitmap(image, colours, first, last) {
  const sheet = document.createElement("canvas");
  sheet.width = last - first;
  sheet.height = image.height;
  const context = sheet.getContext("2d");
  const pixels = context.createImageData(sheet.width, sheet.height);
  let to = 0;
  for (let row = 0; row < image.height; row++) {
    for (let column = first; column < last; column++) {
      const [r, g, b] = colours[image.data[row * image.width + column]];
      pixels.data.set([r, g, b, 255], to);
      to += 4;
    }
  }
  context.putImageData(pixels, 0, 0);
  return sheet;
}

/**
 * The tiles of a picture, one for each caption, in rows that make them as large as possible. In the image they lie
 * side by side, `gap` columns apart. Captions that have no room are left out.
 */
function drawPicture(canvas, image, colours, captions = [""], gap = 0) {
  const { context, width, height } = cleared(canvas);
  const tiles = captions.length;
  const wide = (image.width - (tiles - 1) * gap) / tiles;
  const under = captions.some((caption) => caption) ? 18 : 0;
  const apart = 6;
  const arranged = [1, 2, 3].map((rows) => {
    const columns = Math.ceil(tiles / rows);
    const across = (width - (columns - 1) * apart) / (columns * wide);
    const down = (height / rows - under) / image.height;
    return { rows, columns, scale: Math.min(across, down) };
  });
  const { rows, columns, scale } = arranged.reduce((best, other) => (other.scale > best.scale ? other : best));
  const [w, h] = [wide * scale, image.height * scale];
  const left = (width - columns * w - (columns - 1) * apart) / 2;
  const above = (height - rows * (h + under)) / 2;
  const widest = Math.max(...captions.map((caption) => context.measureText(caption).width)) + 8;
  const every = Math.ceil(widest / (w + apart));
  context.imageSmoothingEnabled = false;
  context.textAlign = "center";
  captions.forEach((caption, i) => {
    const x = left + (i % columns) * (w + apart);
    const y = above + Math.floor(i / columns) * (h + under);
    const first = i * (wide + gap);
    context.drawImage(bitmap(image, colours, first, first + wide), x, y, w, h);
    context.strokeStyle = colour("line");
    context.strokeRect(x + 0.5, y + 0.5, w - 1, h - 1);
    context.fillStyle = colour("soft");
    if ((tiles - 1 - i) % every === 0) context.fillText(caption, x + w / 2, y + h + 11);
  });
}

/** Round numbers between two others: about `most`, and three of them if they are to be had. */
function ticks(low, high, most) {
  if (!(high > low)) return [low];
  let found = [];
  for (let parts = most; found.length < 3 && parts < most + 6; parts++) {
    const step = roundUp((high - low) / parts);
    found = [];
    for (let i = Math.ceil(low / step - 1e-9); i * step <= high + step * 1e-9; i++) found.push(i * step);
  }
  return found;
}

function number(value) {
  if (value === 0 || Math.abs(value) < 1e-12) return "0";
  if (Math.abs(value) >= 10000) return value.toLocaleString("en", { maximumFractionDigits: 0 });
  return String(Number(value.toPrecision(4))).replace("-", "−");
}

/** A time given in microseconds. */
function duration(us) {
  if (us < 1000) return `${number(us)} µs`;
  return us < 1e6 ? `${number(us / 1000)} ms` : `${number(us / 1e6)} s`;
}

/** The next of 1, 2, 5, 10, 20... that is not smaller. */
function roundUp(value) {
  const power = 10 ** Math.floor(Math.log10(value));
  return power * [1, 2, 5, 10].find((factor) => factor * power >= value * (1 - 1e-9));
}

/** Middle of the distances between neighbours of one part, to tell a silence from a step. */
function usualStep(points) {
  const steps = points.slice(1).flatMap(({ t, part }, i) => (part === points[i].part ? [t - points[i].t] : []));
  return steps.sort((a, b) => a - b)[Math.floor(steps.length / 2)] || 1;
}

/**
 * Where points lie along the axis, from 0 to 1: as their times do, with long silences and the time between two
 * parts cut short. `starts` are the points at which a line begins.
 */
function places(points) {
  const times = points.map(({ t }) => t);
  const step = usualStep(points);
  const starts = points.map(({ part }, i) => !i || part !== points[i - 1].part || times[i] - times[i - 1] > 8 * step);
  const along = [0];
  for (let i = 1; i < points.length; i++) along.push(along[i - 1] + (starts[i] ? 2 * step : times[i] - times[i - 1]));
  const whole = along[along.length - 1] + step;
  return { along: along.map((place) => place / whole), step: step / whole, starts };
}

/**
 * Lines over stream time.
 * `points` are `{t, values, part}` in order: with another part, or after a long silence, a line begins anew.
 * `joined` tells whether there are lines at all, or dots. `strips` are `{name, colours}`, a colour or null for each point, drawn above the lines.
 */
function drawLines(
  canvas,
  { points, colours, unit, time, logarithmic = false, joined = true, label = number, strips = [] },
) {
  const { context, width, height } = cleared(canvas);
  const shown = points.flatMap(({ values }) => values.filter((value) => !logarithmic || value > 0));
  let [low, high] = [Math.min(...shown), Math.max(...shown)];
  if (logarithmic) {
    low = 10 ** Math.floor(Math.log10(low));
    high = 10 ** Math.max(Math.ceil(Math.log10(high)), Math.log10(low) + 1);
  } else {
    const margin = (high - low || Math.abs(high) || 1) * 0.06;
    [low, high] = [low - margin, high + margin];
  }
  const box = { left: 72, right: width - 8, top: 8 + strips.length * 15, bottom: height - 38 };
  const marks = logarithmic
    ? Array.from({ length: Math.round(Math.log10(high / low)) + 1 }, (_, i) => low * 10 ** i)
    : ticks(low, high, Math.max(3, Math.floor((box.bottom - box.top) / 36)));
  const y = (value) => {
    const share = logarithmic ? Math.log(value / low) / Math.log(high / low) : (value - low) / (high - low);
    return box.bottom - share * (box.bottom - box.top);
  };
  const { along, step, starts } = places(points);
  const xs = along.map((place) => box.left + place * (box.right - box.left));
  const begins = points.map(({ t }, i) => ({ t, x: xs[i] })).filter((_, i) => starts[i]);
  drawAxes(context, box, { begins, points, xs, marks, y, unit, time, label });
  colours.forEach((stroke, series) => {
    context.strokeStyle = context.fillStyle = stroke;
    context.lineWidth = 1.6;
    context.beginPath();
    points.forEach(({ values }, i) => {
      const value = values[series];
      if (logarithmic && !(value > 0)) return;
      const at = y(value);
      if (!joined || (starts[i] && starts[i + 1] !== false)) context.fillRect(xs[i] - 1.5, at - 1.5, 3, 3);
      if (starts[i] || !joined) context.moveTo(xs[i], at);
      else context.lineTo(xs[i], at);
    });
    context.stroke();
  });
  strips.forEach(({ name, colours: fills }, row) => {
    const top = 4 + row * 15;
    context.fillStyle = colour("soft");
    context.textAlign = "right";
    context.fillText(name, box.left - 6, top + 5);
    fills.forEach((fill, i) => {
      if (!fill) return;
      const until = starts[i + 1] === false ? xs[i + 1] : xs[i] + step * (box.right - box.left);
      context.fillStyle = fill;
      context.fillRect(xs[i], top, Math.max(until - xs[i], 2) + 0.3, 10);
    });
  });
}

function drawAxes(context, box, { begins, points, xs, marks, y, unit, time, label }) {
  context.lineWidth = 1;
  context.textAlign = "right";
  marks.forEach((mark) => {
    const at = Math.round(y(mark)) + 0.5;
    line(context, box.left, at, box.right, at, "grid");
    context.fillStyle = colour("soft");
    context.fillText(label(mark), box.left - 6, Math.min(at, box.bottom - 4));
  });
  context.textAlign = "center";
  let free = box.left - 30;
  timeMarks(begins, points, xs, box).forEach(({ t, x }) => {
    if (begins.length > 1) line(context, Math.round(x) - 3.5, box.top, Math.round(x) - 3.5, box.bottom, "grid");
    const text = t.toFixed(t < 100 ? 2 : 1);
    const half = context.measureText(text).width / 2;
    if (x - half < free || x + half > box.right + 6) return;
    context.fillText(text, x, box.bottom + 14);
    free = x + half + 14;
  });
  context.fillText(time, (box.left + box.right) / 2, box.bottom + 30);
  upward(context, unit, (box.top + box.bottom) / 2);
}

/** Times to write under the axis: where lines begin or, if all is one line, round ones. */
function timeMarks(begins, points, xs, box) {
  if (begins.length > 1 || points.length < 2) return begins;
  const [first, last] = [points[0].t, points[points.length - 1].t];
  const scale = (xs[xs.length - 1] - xs[0]) / (last - first);
  const most = Math.max(2, Math.floor((box.right - box.left) / 80));
  return ticks(first, last, most).map((t) => ({ t, x: xs[0] + (t - first) * scale }));
}

function line(context, fromX, fromY, toX, toY, stroke) {
  context.strokeStyle = colour(stroke);
  context.beginPath();
  context.moveTo(fromX, fromY);
  context.lineTo(toX, toY);
  context.stroke();
}

/** The unit of an axis, written upward at its left. */
function upward(context, text, middle) {
  context.save();
  context.translate(8, middle);
  context.rotate(-Math.PI / 2);
  context.textAlign = "center";
  context.fillStyle = colour("soft");
  context.fillText(text, 0, 0);
  context.restore();
}

/** A panel of bars, up and down, for each cell, as the cells lie. `cells` are `{name, positive, negative}`. */
function drawBars(canvas, cells, largest, filters, unit) {
  const { context, width, height } = cleared(canvas);
  const [left, between, under, above] = [70, 14, 20, 28];
  const side = Math.sqrt(cells.length);
  const w = (width - left - (side - 1) * between - 4) / side;
  const h = (height - under - side * above) / side;
  const below = cells.some(({ negative }) => negative.some((value) => value > 0));
  cells.forEach(({ name, positive, negative }, i) => {
    const x = left + (i % side) * (w + between);
    const top = above - 6 + Math.floor(i / side) * (h + above);
    const zero = below ? top + h / 2 : top + h;
    const reach = zero - top;
    [...(below ? [-largest] : []), 0, largest].forEach((mark) => {
      const at = Math.round(zero - (mark / largest) * reach) + 0.5;
      line(context, x, at, x + w, at, mark === 0 ? "line" : "grid");
      context.fillStyle = colour("soft");
      context.textAlign = "right";
      if (i % side === 0) context.fillText(number(mark), x - 6, at);
    });
    context.textAlign = "left";
    context.fillStyle = colour("text");
    context.fillText(name, x, top - 10);
    const bar = w / positive.length;
    [[positive, "on", -1], [negative, "off", 1]].forEach(([values, fill, direction]) => {
      context.fillStyle = colour(fill);
      values.forEach((value, k) => {
        const length = (Math.min(value, largest) / largest) * reach;
        const from = direction < 0 ? zero - length : zero;
        if (length > 0) context.fillRect(x + k * bar, from, Math.max(bar * 0.8, 1), length);
      });
    });
    if (i < side * (side - 1)) return;
    context.fillStyle = colour("soft");
    context.fillText("1", x, top + h + 12);
    context.textAlign = "right";
    context.fillText(String(filters), x + w, top + h + 12);
    context.textAlign = "center";
    context.fillText("filter", x + w / 2, top + h + 12);
  });
  upward(context, unit, height / 2);
}
