// The panels: what was last said on each channel, drawn when the browser has time.

const KEPT = 200;
const QUIET_MS = 2000;
const MOST_LINES = 40;
const CLASS_COLOURS = [
  "#2f7ed8", "#e8731a", "#2ca25f", "#d6336c", "#8f63d2", "#a06a42", "#e05fb6", "#8a8f98", "#a7a51c", "#17a2b8",
];
const QUADRANTS = ["top left", "top right", "bottom left", "bottom right"];

const DROPS = {
  dropped: "packets dropped",
  lost: "packets lost",
  unheard: "packets before us",
  duplicates: "packets twice",
  reordered: "packets out of order",
  foreign: "packets of others",
  restarts: "publishers anew",
  late: "events too late",
  rejected: "events rejected",
  skipped: "pictures skipped",
  missed: "pictures missed here",
};

const at = (id) => document.getElementById(id);
const model = {
  about: null, cameras: new Map(), camera: null, firstS: null, absolute: false,
  scores: [], latency: [], scale: 0, frame: null, missed: 0, frames: 0,
};
let heardMs = 0;
let open = false;
let dirty = true;

function forget() {
  Object.assign(model, { scores: [], latency: [], scale: 0, frame: null, firstS: null });
  dirty = true;
}

/** Keep a point; time that goes back begins anew. */
function keep(series, point) {
  const last = series[series.length - 1];
  if (last && point.t < last.t) series.length = 0;
  else if (last && point.t === last.t) series.pop();
  series.push(point);
  if (series.length > KEPT) series.shift();
}

const listener = {
  onOpen() {
    open = true;
    model.cameras.clear();
    forget();
  },
  onClose() {
    open = false;
    dirty = true;
  },
  onMessage(camera, channel, message) {
    dirty = true;
    if (channel === "about") {
      const { labels, ...about } = message;
      model.about = { ...about, labels: labels ? JSON.parse(labels) : [] };
      document.body.classList.toggle("plain", !about.formulation);
      document.body.classList.toggle("unjudged", !model.about.labels.length);
      return;
    }
    if (!model.cameras.has(camera)) {
      model.cameras.set(camera, { last: {} });
      offerCameras();
    }
    const { last } = model.cameras.get(camera);
    last[channel] = message;
    if (channel === "player") at("player").hidden = false;
    if (channel === "labels") showLabelling();
    if (channel === "player" || channel === "labels") return;
    if (camera !== model.camera) return;
    if (channel === "events" || channel === "status") heardMs = performance.now();
    if (channel === "status") {
      if (model.frame !== null && message.frame > model.frame + 1) model.missed += message.frame - model.frame - 1;
      if (message.frame !== model.frame) model.frames++;
      model.frame = message.frame;
      if (model.firstS === null || message.t_s < model.firstS) model.firstS = message.t_s;
    }
    if (channel === "engine" && message.update_us.n) {
      const { median, max } = message.update_us;
      keep(model.latency, { t: message.t_s, values: [median, max], part: 0 });
    }
    if (channel === "prediction") {
      const { t_s: t, scores, sample, label } = message;
      keep(model.scores, { t, values: scores, part: sample ? sample.start_s : null, label, truth: sample?.label });
    }
  },
};

/** The cameras there are, to choose from; the first is chosen. */
function offerCameras() {
  const names = [...model.cameras.keys()].sort();
  at("camera").replaceChildren(...names.map((name) => new Option(name.replace(/\/view$/, "") || "recording", name)));
  if (!names.includes(model.camera)) {
    model.camera = names[0];
    forget();
  }
  at("camera").value = model.camera;
  at("chooser").hidden = names.length < 2;
}

/** Draw in a canvas, or say what is missing. */
function panel(id, ready, draw, otherwise = "nothing to show yet") {
  if (ready) draw(at(id));
  else say(at(id), otherwise);
}

function drawAll() {
  dirty = false;
  const { about } = model;
  const { last } = model.cameras.get(model.camera) ?? { last: {} };
  const { status, engine, events, bins, volumes, features } = last;
  document.body.dataset.frames = model.frames;
  document.body.dataset.missed = model.missed;
  const startS = model.absolute ? 0 : model.firstS ?? 0;
  at("time").textContent = status
    ? `${model.absolute ? "camera" : "stream"} time ${(status.t_s - startS).toFixed(2)} s`
    : "";
  drawPlayer(last);
  if (last.labels) drawLabelling(last.labels);
  if (events) at("events-note").textContent = "the latest event of each pixel";
  const binMs = about?.bin_us ? Number(about.bin_us) / 1000 : 0;
  const ms = (value) => `${number(Math.round(value * 10) / 10)} ms`;
  if (about?.formulation) {
    at("model").textContent =
      `${about.formulation}, ${about.encoding}, K = ${about.filters}, patch ${about.patch}, ` +
      `stride ${about.stride}, ${about.bins} bins of ${ms(binMs)}`;
    at("bins-note").textContent = `signed counts, clipped at ±${about.max_count}, in each time bin`;
  }
  at("volumes-note").textContent = engine ? `${engine.active_volumes.toLocaleString("en")} of ${engine.volumes.toLocaleString("en")}` : "";
  panel("events", events, (canvas) => drawPicture(canvas, events, signedColours()));
  panel("bins", bins && about?.bins, (canvas) => {
    const n = Number(about.bins);
    const captions = Array.from({ length: n }, (_, i) => (i === n - 1 ? "now" : `−${ms((n - 1 - i) * binMs)}`));
    // A tile has w columns and a gap max(1, floor(w / 32)).
    let wide = Math.floor(bins.width / n);
    while (wide > 1 && n * wide + (n - 1) * Math.max(1, Math.floor(wide / 32)) > bins.width) wide--;
    drawPicture(canvas, bins, signedColours(), captions, Math.max(1, Math.floor(wide / 32)));
  });
  panel("volumes", volumes, (canvas) => drawPicture(canvas, volumes, plainColours()));
  panel("features", features && about?.filters, (canvas) => drawFeatures(canvas, features));
  drawScores(last.prediction, startS);
  panel("latency", model.latency.length, (canvas) =>
    drawLines(canvas, {
      points: fromStart(model.latency, startS),
      time: `${model.absolute ? "camera" : "stream"} time (s)`,
      colours: [colour("accent"), colour("off")],
      unit: "time, log scale",
      logarithmic: true,
      joined: false,
      label: duration,
    }),
  );
  if (status) drawCounts(status, engine);
}

function drawFeatures(canvas, features) {
  const { cells } = features;
  const side = Math.sqrt(cells.length);
  const place = (i) => (side === 1 ? "whole grid" : `row ${Math.floor(i / side) + 1}, column ${(i % side) + 1}`);
  const named = cells.map((cell, i) => ({ name: side === 2 ? QUADRANTS[i] : place(i), ...cell }));
  // A round scale that changes only where it must, so that it can be read.
  const largest = Math.max(...named.flatMap(({ positive, negative }) => [...positive, ...negative]));
  if (largest > model.scale || largest < model.scale / 4) model.scale = roundUp(largest || 1);
  const shared = features.filters_per_column;
  at("features-note").textContent =
    "pooled codes by cell: positive up, negative down" + (shared > 1 ? `; largest of ${shared} filters` : "");
  drawBars(canvas, named, model.scale, model.about.filters, "pooled code");
}

/** Classes that get a colour: all if they are few, else those that led most often. */
function leaders(labels) {
  if (labels.length <= CLASS_COLOURS.length) return labels.map((_, i) => i);
  const led = new Map();
  model.scores.forEach(({ values }) => {
    const best = values.indexOf(Math.max(...values));
    led.set(best, (led.get(best) ?? 0) + 1);
  });
  const most = [...led].sort((a, b) => b[1] - a[1]).slice(0, CLASS_COLOURS.length);
  return most.map(([i]) => i).sort((a, b) => a - b);
}

/** Points whose time is counted from a start, as in the head of the page. */
const fromStart = (points, startS) => points.map((point) => ({ ...point, t: point.t - startS }));

function drawScores(prediction, startS) {
  const { about } = model;
  if (about && !about.labels.length) {
    at("legend").replaceChildren();
    at("verdict").textContent = "";
    say(at("scores"), "no classifier: give one with -c");
    return;
  }
  if (!prediction || !about) {
    say(at("scores"), "nothing to show yet");
    return;
  }
  const { labels } = about;
  const shown = leaders(labels);
  const of = new Map(shown.map((i, place) => [labels[i], CLASS_COLOURS[place]]));
  const others = labels.map((_, i) => i).filter((i) => !shown.includes(i));
  // Lines of hundreds of classes would take longer to draw than until the next picture, and tell nothing.
  const order = others.length <= MOST_LINES ? [...others, ...shown] : shown;
  const strips = [{ name: "predicted", colours: model.scores.map(({ label }) => of.get(label) ?? null) }];
  if (model.scores.some(({ truth }) => truth !== undefined)) {
    strips.unshift({ name: "label", colours: model.scores.map(({ truth }) => of.get(truth) ?? null) });
  }
  drawLines(at("scores"), {
    points: fromStart(model.scores, startS).map((point) => ({ ...point, values: order.map((i) => point.values[i]) })),
    time: `${model.absolute ? "camera" : "stream"} time (s)`,
    colours: order.map((i) => of.get(labels[i]) ?? colour("line")),
    unit: "score",
    strips,
  });
  at("legend").replaceChildren(
    ...shown.map((i) => entry(of.get(labels[i]), labels[i], prediction.scores[i].toFixed(2).replace("-", "−"))),
    ...(others.length ? [entry(colour("line"), `${others.length} others`, "")] : []),
  );
  drawVerdict(prediction);
}

function entry(fill, name, value) {
  const item = document.createElement("li");
  const [swatch, text, score] = ["i", "span", "b"].map((tag) => document.createElement(tag));
  swatch.style.background = fill;
  text.textContent = text.title = name;
  score.textContent = value;
  item.append(swatch, text, score);
  return item;
}

function drawVerdict({ label, sample, samples, right, incomplete }) {
  const verdict = at("verdict");
  const best = document.createElement("b");
  best.textContent = label;
  verdict.replaceChildren(best);
  if (sample) {
    const truth = document.createElement("span");
    truth.className = sample.label === label ? "right" : "wrong";
    truth.textContent = sample.label === label ? " ✓" : ` ✗ is ${sample.label}`;
    verdict.append(truth);
  }
  if (samples) verdict.append(` · ${right} of ${samples} samples right (${((100 * right) / samples).toFixed(1)} %)`);
  if (incomplete) verdict.append(" · packets are missing");
}

function drawCounts(status, engine) {
  const rows = [
    ["events", status.events.toLocaleString("en")],
    ["event rate", `${status.events_per_s.toLocaleString("en")} /s`],
    ["sensor", `${status.width} × ${status.height} pixels`],
    ...(engine
      ? [
          ["update, median", duration(engine.update_us.median)],
          ["update, longest", duration(engine.update_us.max)],
        ]
      : []),
  ].map(([name, value]) => [name, value, false]);
  const drops = { ...status.drops, missed: model.missed };
  Object.entries(drops)
    .filter(([, n]) => n > 0)
    .forEach(([name, n]) => rows.push([DROPS[name] ?? name, n.toLocaleString("en"), true]));
  at("counts").replaceChildren(
    ...rows.map(([name, value, some]) => {
      const row = document.createElement("div");
      const [term, text] = [document.createElement("dt"), document.createElement("dd")];
      row.className = some ? "some" : "";
      [term.textContent, text.textContent] = [name, value];
      row.append(term, text);
      return row;
    }),
  );
}

function tellState() {
  const quiet = performance.now() - heardMs;
  const state = at("state");
  const live = open && model.frames && quiet < QUIET_MS;
  state.className = live ? "live" : "";
  const player = lastOf("player");
  if (!open) state.textContent = "connection lost, trying again";
  else if (player?.ended || player?.paused) state.textContent = player.ended ? "at the end" : "paused";
  else if (!model.frames) state.textContent = "connected, waiting for events";
  else state.textContent = live ? "live" : `no new picture for ${Math.round(quiet / 1000)} s`;
}

function turn() {
  if (dirty) drawAll();
  tellState();
  requestAnimationFrame(turn);
}

const stream = new Stream(document.body.dataset.port, document.body.dataset.token, listener);
at("camera").onchange = () => {
  model.camera = at("camera").value;
  forget();
};
at("time").onclick = () => {
  model.absolute = !model.absolute;
  dirty = true;
};
const redraw = () => {
  dirty = true;
};
window.addEventListener("resize", redraw);
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
requestAnimationFrame(turn);
