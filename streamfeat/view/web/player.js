// The player: its buttons and keys, and the timeline with the event rate, to click, drag and zoom in.

const NEAR_PX = 6;
const MOVED_PX = 4;
const MOST_ZOOM = 500;

/** What of the recording the timeline shows, as shares of it, and what a pointer is about to do there. */
const timeline = { from: 0, to: 1, drag: null };

const lengthS = (last) => (last.timeline ? last.timeline.column_s * last.timeline.counts.length : 0);
const lastOf = (channel) => model.cameras.get(model.camera)?.last[channel];

/** Between played seconds and pixels of the timeline. */
function scaleOf(seconds, width) {
  const { from, to } = timeline;
  return {
    x: (s) => ((s / seconds - from) / (to - from)) * width,
    s: (x) => Math.min(Math.max((from + (x / width) * (to - from)) * seconds, 0), seconds),
  };
}

function drawPlayer(last) {
  const { player } = last;
  if (!player) return;
  at("play").textContent = player.ended ? "again" : player.paused ? "play" : "pause";
  const whole = lengthS(last);
  at("at").textContent = `${player.at_s.toFixed(2)}${last.timeline?.done ? ` of ${whole.toFixed(2)}` : ""} s`;
  if (document.activeElement !== at("speed")) at("speed").value = player.speed ?? "";
  if (!last.timeline) return;
  const { context, width, height } = cleared(at("timeline"));
  const { counts, column_s: columnS } = last.timeline;
  const { x } = scaleOf(whole, width);
  const most = Math.max(1, ...counts);
  const column = Math.max(x(columnS) - x(0), 0.6);
  const under = last.labels ? 18 : 0;
  context.fillStyle = colour("bars");
  counts.forEach((count, i) => {
    const tall = (count / most) * (height - under - 4);
    context.fillRect(x(i * columnS), height - under - tall, column, tall);
  });
  if (last.labels) drawLabels(context, last.labels, player, x, height);
  context.fillStyle = colour("accent");
  context.fillRect(x(player.at_s) - 1, 0, 2, height);
}

function toggle() {
  const player = lastOf("player");
  if (player?.ended) stream.ask("seek", { value: 0 });
  else if (player) stream.ask("pause", { value: !player.paused });
}

function seek(toS) {
  const { firstS } = model;
  forget();
  model.firstS = firstS;
  stream.ask("seek", { value: Math.max(0, toS) });
}

/** Seconds under a pointer, and what it may move there. */
function under(event) {
  const last = model.cameras.get(model.camera)?.last;
  if (!last?.timeline) return null;
  const { x, s } = scaleOf(lengthS(last), at("timeline").clientWidth);
  return { x, s: s(event.offsetX), offset: event.offsetX };
}

at("play").onclick = toggle;
at("step").onclick = () => stream.ask("step");
at("speed").onchange = () => {
  stream.ask("speed", { value: at("speed").value ? Number(at("speed").value) : null });
  at("speed").blur();
};
at("timeline").onpointerdown = (event) => {
  const place = under(event);
  if (!place) return;
  at("timeline").setPointerCapture(event.pointerId);
  timeline.drag = { offset: place.offset, s: place.s, edge: edgeAt(place), moved: false };
};
at("timeline").onpointermove = (event) => {
  const place = under(event);
  if (!place) return;
  const { drag } = timeline;
  at("timeline").style.cursor = (drag ? drag.edge : edgeAt(place)) ? "ew-resize" : "pointer";
  if (!drag) return;
  drag.moved ||= Math.abs(place.offset - drag.offset) > MOVED_PX;
  if (drag.moved && lastOf("labels")) markTo(drag, place.s);
};
at("timeline").onpointerup = (event) => {
  const place = under(event);
  const { drag } = timeline;
  timeline.drag = null;
  if (!place || !drag) return;
  if (drag.moved && lastOf("labels")) {
    marked(drag);
    return;
  }
  choose(place.s);
  seek(place.s);
};
at("timeline").onwheel = (event) => {
  const place = under(event);
  if (!place) return;
  event.preventDefault();
  const share = place.offset / at("timeline").clientWidth;
  const { from, to } = timeline;
  const wide = Math.min(Math.max((to - from) * 1.2 ** Math.sign(event.deltaY), 1 / MOST_ZOOM), 1);
  timeline.from = Math.min(Math.max(from + share * (to - from - wide), 0), 1 - wide);
  timeline.to = timeline.from + wide;
  dirty = true;
};
at("timeline").ondblclick = () => {
  Object.assign(timeline, { from: 0, to: 1 });
  dirty = true;
};
document.addEventListener("keydown", (event) => {
  const player = lastOf("player");
  if (!player || event.target.matches("select, input")) return;
  const does = {
    " ": toggle,
    ".": () => stream.ask("step"),
    ArrowLeft: () => seek(player.at_s - 1),
    ArrowRight: () => seek(player.at_s + 1),
    ...labelKeys(event),
  }[event.key];
  if (!does || (event.key === " " && event.target.matches("button"))) return;
  event.preventDefault();
  does();
});
