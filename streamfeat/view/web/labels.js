// Labels: intervals of the recording with a name, marked by key or by dragging (see view/labelling.py).

/**
 * What is being marked: from where on and as what, by key; a range that has no name yet; the key of a label that
 * was chosen; and that label's new ends while one is dragged.
 */
const marking = { open: null, range: null, chosen: null, moved: null };

const classColour = (classes, name) => CLASS_COLOURS[Math.max(classes.indexOf(name), 0) % CLASS_COLOURS.length];
const chosenLabel = () => lastOf("labels")?.labels.find((label) => label.at === marking.chosen);

function showLabelling() {
  at("labelling").hidden = false;
  document.body.classList.add("labelled");
}

function drawLabelling({ classes, labels, file, saved, problem, can_undo: canUndo }) {
  const buttons = classes.map((name, i) => {
    const button = document.createElement("button");
    const [swatch, text, key] = ["i", "span", "kbd"].map((tag) => document.createElement(tag));
    swatch.style.background = classColour(classes, name);
    key.textContent = i < 9 ? i + 1 : "";
    text.textContent = text.title = name;
    button.append(swatch, text, key);
    button.className = marking.open?.name === name ? "open" : "";
    button.dataset.name = name;
    return button;
  });
  const old = [...at("classes").children].map((button) => button.outerHTML).join();
  if (old !== buttons.map((button) => button.outerHTML).join()) at("classes").replaceChildren(...buttons);
  at("undo").disabled = !canUndo;
  at("remove").disabled = !chosenLabel();
  const n = labels.length;
  at("label-state").textContent = problem || `${n} label${n === 1 ? "" : "s"} ${saved ? "saved in" : "for"} ${file}`;
  at("label-state").className = problem ? "bad" : "";
  at("label-hint").textContent = hint(classes);
}

function hint(classes) {
  if (marking.open) return `${marking.open.name} from ${marking.open.s.toFixed(2)} s: the same key again ends it`;
  if (!classes.length) return "first name a class, such as: wave";
  if (marking.range) return "press the key of its class, 1 to 9; Esc lets go of it";
  const label = chosenLabel();
  if (label) {
    const [start, end] = [label.start_s.toFixed(2), label.end_s.toFixed(2)];
    return `${label.label}, ${start} to ${end} s: drag its ends, press another class's key, or Del to remove it`;
  }
  return "press its key where a label begins and again where it ends, or drag over the timeline and press the key";
}

/** The labels under the columns of the timeline, and what is being marked. */
function drawLabels(context, { classes, labels }, player, x, height) {
  const bar = (start, end, fill, name, strong) => {
    const [left, right] = [x(Math.min(start, end)), x(Math.max(start, end))];
    const wide = Math.max(right - left, 2);
    context.globalAlpha = strong ? 0.4 : 0.16;
    context.fillStyle = fill;
    context.fillRect(left, 0, wide, height - 18);
    context.globalAlpha = 1;
    context.fillRect(left, height - 16, wide, 16);
    if (wide < 14) return;
    context.save();
    context.beginPath();
    context.rect(left, height - 16, wide - 2, 16);
    context.clip();
    context.fillStyle = "#fff";
    context.textAlign = "left";
    context.fillText(name, left + 4, height - 8);
    context.restore();
  };
  labels.forEach((label) => {
    const chosen = label.at === marking.chosen;
    const { start_s: start, end_s: end } = chosen && marking.moved ? marking.moved : label;
    bar(start, end, classColour(classes, label.label), label.label, chosen);
  });
  const { open, range } = marking;
  if (open) bar(open.s, player.at_s, classColour(classes, open.name), open.name, true);
  if (range) bar(range[0], range[1], colour("soft"), "?", true);
}

/** Which end of the chosen label a pointer is at. */
function edgeAt({ x, offset }) {
  const label = chosenLabel();
  if (!label) return null;
  if (Math.abs(x(label.start_s) - offset) < NEAR_PX) return "start_s";
  return Math.abs(x(label.end_s) - offset) < NEAR_PX ? "end_s" : null;
}

function markTo(drag, s) {
  if (drag.edge) marking.moved = { ...chosenLabel(), [drag.edge]: s };
  else Object.assign(marking, { range: [Math.min(drag.s, s), Math.max(drag.s, s)], chosen: null, open: null });
  dirty = true;
}

function marked({ edge }) {
  const { moved } = marking;
  if (!edge || !moved) return;
  relabel(moved, moved.label);
}

function relabel({ at: key, start_s: a, end_s: b }, label) {
  stream.ask("relabel", { at: key, start: Math.min(a, b), end: Math.max(a, b), label });
  Object.assign(marking, { moved: null, chosen: null });
}

/** Choose the label at a time, if there is one. */
function choose(s) {
  const found = lastOf("labels")?.labels.find(({ start_s: start, end_s: end }) => start <= s && s < end);
  Object.assign(marking, { chosen: found ? found.at : null, range: null, moved: null });
  dirty = true;
}

/** What a class's key or button does: name what is marked or chosen, else begin a label, or end it. */
function press(name) {
  const player = lastOf("player");
  const { open, range } = marking;
  const label = chosenLabel();
  marking.open = null;
  if (range) {
    stream.ask("label", { start: range[0], end: range[1], label: name });
    marking.range = null;
  } else if (label && !open) {
    relabel(label, name);
  } else {
    const now = player.at_s;
    if (open && open.s !== now) {
      stream.ask("label", { start: Math.min(open.s, now), end: Math.max(open.s, now), label: open.name });
    }
    if (open?.name !== name) marking.open = { s: now, name };
  }
  dirty = true;
}

function letGo() {
  Object.assign(marking, { open: null, range: null, chosen: null, moved: null });
  dirty = true;
}

function remove() {
  if (chosenLabel()) stream.ask("unlabel", { at: marking.chosen });
  marking.chosen = null;
  dirty = true;
}

function labelKeys(event) {
  const sheet = lastOf("labels");
  if (!sheet) return {};
  const keys = Object.fromEntries(sheet.classes.slice(0, 9).map((name, i) => [i + 1, () => press(name)]));
  const undo = { u: () => stream.ask("undo"), z: event.ctrlKey || event.metaKey ? () => stream.ask("undo") : null };
  return { ...keys, ...undo, Escape: letGo, Delete: remove, Backspace: remove };
}

at("classes").onclick = (event) => {
  const name = event.target.closest("button")?.dataset.name;
  if (name) press(name);
};
at("undo").onclick = () => stream.ask("undo");
at("remove").onclick = remove;
at("new-class").onkeydown = (event) => {
  if (event.key === "Escape") at("new-class").blur();
  if (event.key !== "Enter" || !at("new-class").value.trim()) return;
  stream.ask("class", { label: at("new-class").value });
  at("new-class").value = "";
  at("new-class").blur();
};
