/* ---- controls: keys, pointers and buttons ---- */

const choices = {
  mode: (mode) => { if (MODES.includes(mode) && content.layers.before) state.mode = mode; },
  generated: (how) => {
    if (!GENERATED.includes(how)) return;
    state.generated = how;
    for (const picture of pictures) picture.setGenerated(how);
  },
  drag: (drag) => {
    if (!DRAGS.includes(drag) || (drag === "box" && !content.live)) return;
    state.drag = drag;
    stage.dataset.drag = drag;
    byId("brush").hidden = !PAINTS.includes(drag);
    showBox(drag === "box");
    // A single picture fills the stage, and is what is marked.
    const needsWhole = PAINTS.includes(drag) || drag === "box";
    if (needsWhole && ["side", "slider"].includes(state.mode)) choose("mode", "after");
  },
};

/* Sets a choice, shows which it is, and says so. */
function choose(kind, value) {
  choices[kind](value);
  for (const button of document.querySelectorAll(`button[data-${kind}]`)) {
    button.setAttribute("aria-pressed", String(button.dataset[kind] === state[kind]));
  }
  link();
  changed();
}

function next(kind, values) {
  choose(kind, values[(values.indexOf(state[kind]) + 1) % values.length]);
}

function hold(held) {
  if (!content.layers.before || state.held === held) return;
  state.held = held;
  byId("hold").setAttribute("aria-pressed", String(held));
  changed();
}

function setDivider(percent) {
  state.divider = Math.min(100, Math.max(0, percent));
  byId("divider").setAttribute("aria-valuenow", String(Math.round(state.divider)));
  changed();
}

const MOVES = { KeyW: [0, 0, -1], KeyS: [0, 0, 1], KeyA: [-1, 0, 0], KeyD: [1, 0, 0], KeyE: [0, 1, 0], KeyQ: [0, -1, 0] };
const TURNS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
const pressed = new Set();
let lastTick = 0;

/* Does what a moving key does in so many seconds. */
function moveByKey(code, seconds) {
  if (MOVES[code]) moveBy(...MOVES[code].map((part) => part * MOVE_BY_KEY * seconds * state.focus));
  if (TURNS[code]) turnBy(...TURNS[code].map((part) => part * TURN_BY_KEY * seconds), false);
}

/* Moves by the keys that are held, once a frame. */
function tick(now) {
  const seconds = Math.min(Math.max(0, now - lastTick) / 1000, LONGEST_STEP);
  lastTick = now;
  for (const code of pressed) moveByKey(code, seconds);
  if (pressed.size > 0) requestAnimationFrame(tick);
}

/* However short a key is pressed, it moves by a step. */
function press(code) {
  if (pressed.has(code)) return;
  play(false);
  moveByKey(code, SHORTEST_STEP);
  lastTick = performance.now();
  if (pressed.size === 0) requestAnimationFrame(tick);
  pressed.add(code);
}

const KEYS = {
  1: () => choose("mode", "side"),
  2: () => choose("mode", "slider"),
  3: () => choose("mode", "before"),
  4: () => choose("mode", "after"),
  g: () => next("generated", GENERATED),
  f: () => choose("drag", state.drag === "orbit" ? "fly" : "orbit"),
  m: () => choose("drag", state.drag === "mark" ? "orbit" : "mark"),
  l: () => choose("drag", state.drag === "lasso" ? "orbit" : "lasso"),
  x: () => choose("drag", state.drag === "box" ? "orbit" : "box"),
  c: saveCamera,
  n: saveMask,
  z: undoStroke,
  y: redoStroke,
  ",": () => widen(1 / WIDENING),
  ".": () => widen(WIDENING),
  b: () => hold(true),
  r: () => goTo(state.shot),
  p: () => play(!state.playing),
  "[": () => step(-1),
  "]": () => step(1),
  "?": () => { byId("help").open = !byId("help").open; },
  h: () => ask("complete"),
  i: () => ask("fill"),
  delete: () => ask("remove"),
  enter: () => ask("repair"),
  u: () => ask("undo"),
  o: () => ask("redo"),
  j: () => ask("find"),
  v: () => ask("save"),
  t: nextHandles,
};

/* Ctrl+Z and Ctrl+Y, or with Shift, as everywhere: a stroke first, else a step of the scene. */
function undoOrRedo(event) {
  const goesBack = event.key.toLowerCase() === "z" && !event.shiftKey;
  if (goesBack && strokes.length > 0) undoStroke();
  else if (goesBack) ask("undo");
  else if (undoneStrokes.length > 0) redoStroke();
  else ask("redo");
  event.preventDefault();
}

function onKeyDown(event) {
  if (event.target.tagName === "INPUT" && event.target.type === "number") return;
  if ((event.ctrlKey || event.metaKey) && ["z", "y"].includes(event.key.toLowerCase())) undoOrRedo(event);
  if (event.ctrlKey || event.metaKey || event.altKey || !state.eye) return;
  if (event.target === byId("width") && event.key.startsWith("Arrow")) return;
  if (event.target.tagName === "BUTTON" && event.key === "Enter") return;
  if (PAINTS.includes(state.drag) && event.code === "KeyE") {
    if (!event.repeat) erase(!state.erases);
  } else if (event.target === byId("divider") && event.key.startsWith("Arrow")) {
    setDivider(state.divider + (["ArrowLeft", "ArrowDown"].includes(event.key) ? -2 : 2));
  } else if (MOVES[event.code] || (TURNS[event.code] && event.target === stage)) {
    press(event.code);
  } else if (KEYS[event.key.toLowerCase()] && !event.repeat) {
    KEYS[event.key.toLowerCase()]();
  } else {
    return;
  }
  event.preventDefault();
}

function onKeyUp(event) {
  pressed.delete(event.code);
  if (event.key.toLowerCase() === "b") hold(false);
}

const pointers = new Map();

function onPointerDown(event) {
  if (!state.eye) return;
  play(false);
  stage.setPointerCapture(event.pointerId);
  pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
  if (!PAINTS.includes(state.drag)) return;
  if (pointers.size === 1) beginStroke(event);
  // A second finger means that both move the camera.
  else if (pointers.size === 2) undoStroke();
}

/* One pointer turns or, with Shift or another button, moves; two move and change the distance. */
function onPointerMove(event) {
  const before = pointers.get(event.pointerId);
  if (!before || isBoxDragged()) return;
  const now = { x: event.clientX, y: event.clientY };
  if (PAINTS.includes(state.drag) && pointers.size === 1) {
    extendStroke(event);
    pointers.set(event.pointerId, now);
    return;
  }
  const share = 1 / (stage.clientHeight * pointers.size);
  const [right, down] = [(now.x - before.x) * share, (now.y - before.y) * share];
  if (pointers.size === 1 && !event.shiftKey && event.buttons === 1) {
    const orbits = state.drag !== "fly";
    const sense = orbits ? 1 : -1;
    turnBy(sense * right * TURN_BY_DRAG, sense * down * TURN_BY_DRAG, orbits);
  } else {
    const seen = state.focus * state.size[1] / state.lens[1];
    moveBy(-right * seen, down * seen, 0);
  }
  const others = [...pointers].filter(([id]) => id !== event.pointerId).map(([, place]) => place);
  if (others.length === 1) {
    const apart = (place) => Math.max(1, Math.hypot(place.x - others[0].x, place.y - others[0].y));
    dolly(apart(before) / apart(now));
  }
  pointers.set(event.pointerId, now);
}

function onPointerEnd(event) {
  pointers.delete(event.pointerId);
}

function onWheel(event) {
  event.preventDefault();
  play(false);
  if (PAINTS.includes(state.drag)) widen(event.deltaY > 0 ? 1 / WIDENING : WIDENING);
  else if (state.eye) dolly(Math.exp(Math.max(-0.5, Math.min(0.5, event.deltaY * 0.002))));
}

function onDividerMove(event) {
  if (!event.buttons) return;
  const box = stage.getBoundingClientRect();
  setDivider(100 * (event.clientX - box.left) / box.width);
}

function listen() {
  window.addEventListener("keydown", onKeyDown);
  window.addEventListener("keyup", onKeyUp);
  window.addEventListener("blur", () => { pressed.clear(); hold(false); });
  window.addEventListener("hashchange", followLink);
  new ResizeObserver(changed).observe(stage);
  stage.addEventListener("pointerdown", onPointerDown);
  stage.addEventListener("pointermove", onPointerMove);
  stage.addEventListener("pointerup", onPointerEnd);
  stage.addEventListener("pointercancel", onPointerEnd);
  stage.addEventListener("wheel", onWheel, { passive: false });
  stage.addEventListener("contextmenu", (event) => event.preventDefault());
  // What lies over the picture is no part of it.
  for (const kind of ["pointerdown", "wheel"]) byId("options").addEventListener(kind, (event) => event.stopPropagation());
  const divider = byId("divider");
  divider.addEventListener("pointerdown", (event) => {
    event.stopPropagation();
    divider.setPointerCapture(event.pointerId);
  });
  divider.addEventListener("pointermove", (event) => { event.stopPropagation(); onDividerMove(event); });
  byId("hold").addEventListener("pointerdown", () => hold(true));
  for (const end of ["pointerup", "pointerleave", "pointercancel"]) byId("hold").addEventListener(end, () => hold(false));
  byId("hold").addEventListener("keydown", (event) => { if ([" ", "Enter"].includes(event.key)) hold(true); });
  byId("hold").addEventListener("keyup", () => hold(false));
  byId("play").addEventListener("click", () => play(!state.playing));
  byId("width").addEventListener("input", (event) => {
    widen(NARROWEST * (WIDEST / NARROWEST) ** event.target.valueAsNumber / state.brush);
  });
  byId("erase").addEventListener("click", () => erase(!state.erases));
  byId("undo").addEventListener("click", undoStroke);
  byId("redo").addEventListener("click", redoStroke);
  byId("save-camera").addEventListener("click", saveCamera);
  byId("save-mask").addEventListener("click", saveMask);
  for (const kind of Object.keys(choices)) {
    for (const button of document.querySelectorAll(`button[data-${kind}]`)) {
      button.addEventListener("click", () => choose(kind, button.dataset[kind]));
    }
  }
}

