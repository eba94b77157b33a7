"use strict";
/* The page's program. One state, the same for both pictures: where the camera is, its lens, what is
compared. Whatever changes it calls `changed`, and both pictures are drawn anew.

Positions and turns are in the page's frame (x right, y up, z back; see page.py). A lens is that of
a photograph: fx, fy, cx, cy in pixels of its size, the centre of the top-left one at (0.5, 0.5). */

const MODES = ["side", "slider", "before", "after"];
const GENERATED = ["show", "tint", "hide"];
const DRAGS = ["orbit", "fly", "mark"];
/* What the colours of generated Gaussians are multiplied by. */
const TINT = [1.3, 0.5, 1.2];
/* Near and far plane, in the page's unit. */
const NEAR = 0.005;
const FAR = 20000;
/* The shape of a splat on the screen, as 3DGS has it: 0.3 px² are added to its covariance, what is
   below alpha 1/255 is left out, and the farthest comes first by z-depth. */
const AS_3DGS = {
  preBlurAmount: 0.3, blurAmount: 0, minAlpha: 1 / 255, maxStdDev: Math.sqrt(11.1),
  maxPixelRadius: 4096, sortRadial: false, accumExtSplats: true, enableLod: false,
};
/* The same of antialiased Gaussians: what is added takes as much of their opacity. */
const AS_ANTIALIASED = { ...AS_3DGS, preBlurAmount: 0, blurAmount: 0.3 };
/* Radians that a drag over the whole height turns, and that a second of an arrow key does. */
const TURN_BY_DRAG = Math.PI;
const TURN_BY_KEY = 0.8;
/* Distances to what is looked at that a second of a moving key covers. */
const MOVE_BY_KEY = 0.6;
/* Seconds that a key counts for at least, and that a slow frame counts for at most. */
const SHORTEST_STEP = 0.03;
const LONGEST_STEP = 0.1;
/* Narrowest and widest brush, relative to the longer side of the photograph, and the factor that a
   key widens it by. */
const NARROWEST = 0.005;
const WIDEST = 0.3;
const WIDENING = 1.25;
/* Colour of what is marked, over the picture. */
const MARK_COLOUR = "rgb(255 0 80 / 55%)";
/* How near to straight up or down one may look: the cosine. */
const STEEPEST = 0.995;

const content = JSON.parse(document.getElementById("content").textContent);
const shotNamed = new Map(content.shots.map((shot) => [shot.name, shot]));
const byId = (id) => document.getElementById(id);
const stage = byId("stage");

const state = {
  mode: content.layers.before ? "side" : "after",
  held: false,
  generated: "show",
  drag: "orbit",
  divider: 50,
  shot: null,
  eye: null,
  turn: null,
  up: null,
  focus: 1,
  lens: null,
  size: null,
  seconds: 0,
  playing: false,
  brush: 0.06,
  erases: false,
};
let THREE, SPARK;
let pictures = [];
let path = [];
let frames = 0;
let pending = 0;
/* What is marked in the photograph of the camera `marked`: strokes of {points, width, erases}, in its
   pixels. */
let strokes = [];
let marked = "";

/* ------------------------------------------------------------------------------ libraries */

/* Imports the modules that the page brings, from addresses of its own memory. */
async function importLibraries() {
  const imports = {};
  for (const [name, text] of Object.entries(content.modules)) {
    imports[name] = URL.createObjectURL(new Blob([text], { type: "text/javascript" }));
  }
  const map = document.createElement("script");
  map.type = "importmap";
  map.textContent = JSON.stringify({ imports });
  document.head.append(map);
  THREE = await import("three");
  SPARK = await import("@sparkjsdev/spark");
}

/* The bytes of a source, put together from its parts. */
function bytesOf(name) {
  const parts = (gscSources[name] ?? []).map((text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0)));
  const bytes = new Uint8Array(parts.reduce((length, part) => length + part.length, 0));
  let end = 0;
  for (const part of parts) {
    bytes.set(part, end);
    end += part.length;
  }
  return bytes;
}

/* ------------------------------------------------------------------------------- pictures */

/* One canvas, and the layers of Gaussians that it shows. */
class Picture {
  constructor(figure, layers) {
    this.figure = figure;
    this.canvas = figure.querySelector("canvas");
    this.renderer = new THREE.WebGLRenderer({ canvas: this.canvas, antialias: false });
    this.camera = new THREE.PerspectiveCamera();
    this.camera.matrixAutoUpdate = false;
    this.scene = new THREE.Scene();
    const shape = layers.some((layer) => content.antialiased[layer]) ? AS_ANTIALIASED : AS_3DGS;
    this.spark = new SPARK.SparkRenderer({ renderer: this.renderer, autoUpdate: false, ...shape });
    this.scene.add(this.spark);
    this.meshes = {};
    this.stale = false;
    this.updating = false;
    for (const name of layers.filter((layer) => content.layers[layer])) {
      const fileBytes = bytesOf(content.layers[name]);
      this.meshes[name] = new SPARK.SplatMesh({ fileBytes, fileType: SPARK.SplatFileType.SPZ, extSplats: true });
      this.scene.add(this.meshes[name]);
    }
  }

  get ready() {
    return Promise.all(Object.values(this.meshes).map((mesh) => mesh.initialized));
  }

  get shown() {
    return getComputedStyle(this.figure).visibility === "visible";
  }

  /* Draws the state, at once in the old order of the Gaussians and again in the new one. */
  draw() {
    const { clientWidth: width, clientHeight: height } = this.figure;
    if (!this.shown || width === 0 || height === 0) return;
    this.renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
    this.renderer.setSize(width, height, false);
    this.place(width, height);
    this.renderer.render(this.scene, this.camera);
    this.stale = true;
    if (!this.updating) this.update();
  }

  place(width, height) {
    const { camera } = this;
    camera.near = NEAR;
    camera.far = FAR;
    camera.matrix.compose(state.eye, state.turn, new THREE.Vector3(1, 1, 1));
    camera.matrix.decompose(camera.position, camera.quaternion, camera.scale);
    camera.updateMatrixWorld(true);
    camera.projectionMatrix.copy(projection(state.lens, state.size, width, height));
    camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
  }

  async update() {
    this.updating = true;
    while (this.stale) {
      this.stale = false;
      await this.spark.update({ scene: this.scene, camera: this.camera });
      this.renderer.render(this.scene, this.camera);
      frames += 1;
    }
    this.updating = false;
  }

  setGenerated(how) {
    const mesh = this.meshes.generated;
    if (!mesh) return;
    mesh.visible = how !== "hide";
    mesh.recolor.setRGB(...(how === "tint" ? TINT : [1, 1, 1]));
  }
}

/* The projection of a lens onto a canvas that shows the whole photograph, in its middle. */
function projection([fx, fy, cx, cy], [photoWidth, photoHeight], width, height) {
  const zoom = Math.min(width / photoWidth, height / photoHeight);
  const x = width / 2 + zoom * (cx - photoWidth / 2);
  const y = height / 2 + zoom * (cy - photoHeight / 2);
  const depth = FAR - NEAR;
  return new THREE.Matrix4().set(
    2 * zoom * fx / width, 0, 1 - 2 * x / width, 0,
    0, 2 * zoom * fy / height, 2 * y / height - 1, 0,
    0, 0, -(FAR + NEAR) / depth, -2 * FAR * NEAR / depth,
    0, 0, -1, 0,
  );
}

function changed() {
  if (!pending) pending = requestAnimationFrame(drawAll);
}

function drawAll() {
  pending = 0;
  stage.dataset.shown = state.held ? "before" : state.mode;
  stage.style.setProperty("--divider", `${state.divider}%`);
  for (const picture of pictures) picture.draw();
  drawMarks();
}

/* Resolves once nothing is left to be sorted or drawn, or at once while the path is played. */
async function settled() {
  const idle = () => !pending && pictures.every((picture) => !picture.updating);
  do {
    await new Promise((resolve) => requestAnimationFrame(resolve));
  } while (!state.playing && !idle());
}

/* --------------------------------------------------------------------------------- camera */

function goTo(name) {
  const shot = shotNamed.get(name);
  if (!shot) return false;
  play(false);
  state.seconds = path.find((stop) => stop.shot === shot).time;
  lookFrom(numbersOf(shot));
  state.shot = name;
  tellShot(shot);
  link();
  return true;
}

function step(by) {
  const names = content.shots.map((shot) => shot.name);
  const at = names.indexOf(state.shot);
  goTo(names[(at + by + names.length) % names.length]);
}

/* ------------------------------------------------------------------------------------ path */

/* What describes a shot as one list: eye, turn, lens, size, focus. */
function numbersOf({ pose, lens, size, focus }) {
  const matrix = new THREE.Matrix4().set(...pose);
  const turn = new THREE.Quaternion().setFromRotationMatrix(matrix);
  return [...new THREE.Vector3().setFromMatrixPosition(matrix), ...turn, ...lens, ...size, focus];
}

function lookFrom(numbers) {
  state.eye = new THREE.Vector3().fromArray(numbers);
  state.turn = new THREE.Quaternion().fromArray(numbers, 3).normalize();
  Object.assign(state, { lens: numbers.slice(7, 11), size: numbers.slice(11, 13), focus: numbers[13] });
  changed();
}

/* The stops of the path: shot, time and numbers, with the sign of a turn nearer to the one before. */
function makePath() {
  path = content.path.map(([index, time]) => ({ shot: content.shots[index], time, at: numbersOf(content.shots[index]) }));
  const turnOf = ({ at }) => new THREE.Quaternion().fromArray(at, 3);
  for (const [k, stop] of path.entries()) {
    if (k > 0 && turnOf(stop).dot(turnOf(path[k - 1])) < 0) stop.at = stop.at.map((value, i) => (i > 2 && i < 7 ? -value : value));
  }
}

/* Moves the camera to where the path is after so many seconds: a cubic spline through its stops, to
   the last one and back, at rest at both. */
function seek(seconds) {
  const end = path.at(-1).time;
  const time = end - Math.abs(end - (seconds % (2 * end)));
  const k = Math.min(path.findLastIndex((stop) => stop.time <= time), path.length - 2);
  const [before, from, to, after] = [-1, 0, 1, 2].map((by) => path[k + by]);
  const speed = (a, b, i) => (a && b ? (b.at[i] - a.at[i]) / (b.time - a.time) : 0);
  const length = to.time - from.time;
  const u = (time - from.time) / length;
  lookFrom(from.at.map((value, i) => value + u * u * (3 - 2 * u) * (to.at[i] - value)
    + length * u * (1 - u) * ((1 - u) * speed(before, to, i) - u * speed(from, after, i))));
  const { shot } = u < 0.5 ? from : to;
  if (shot.name !== state.shot) tellShot(shot);
  Object.assign(state, { seconds, shot: shot.name });
}

/* Plays the path from the camera shown last on, or pauses it. */
function play(playing) {
  if (playing === state.playing || path.length < 2) return;
  state.playing = playing;
  byId("play").setAttribute("aria-pressed", String(playing));
  byId("play").textContent = playing ? "Pause" : "Play";
  if (!playing) return;
  lastTick = performance.now();
  requestAnimationFrame(fly);
}

function fly(now) {
  if (!state.playing) return;
  const seconds = Math.min(Math.max(0, now - lastTick) / 1000, LONGEST_STEP);
  lastTick = now;
  seek(state.seconds + seconds);
  requestAnimationFrame(fly);
}

const axis = (x, y, z) => new THREE.Vector3(x, y, z).applyQuaternion(state.turn);

/* What is up for most cameras. */
function upOfAll() {
  const up = new THREE.Vector3();
  for (const shot of content.shots) up.add(new THREE.Vector3(shot.pose[1], shot.pose[5], shot.pose[9]));
  return up.lengthSq() > 0 ? up.normalize() : new THREE.Vector3(0, 1, 0);
}

/* Turns by angles to the right and down: the camera about itself, or about what it looks at. */
function turnBy(right, down, orbits) {
  const sideways = new THREE.Quaternion().setFromAxisAngle(state.up, -right);
  const upDown = new THREE.Quaternion().setFromAxisAngle(axis(1, 0, 0), -down);
  const turn = sideways.multiply(upDown);
  const forward = axis(0, 0, -1);
  const steep = (direction) => Math.abs(direction.dot(state.up));
  const turned = forward.clone().applyQuaternion(turn);
  if (steep(turned) > STEEPEST && steep(turned) > steep(forward)) return;
  if (orbits) {
    const pivot = state.eye.clone().addScaledVector(forward, state.focus);
    state.eye.copy(pivot).addScaledVector(turned, -state.focus);
  }
  state.turn.premultiply(turn).normalize();
  changed();
}

function moveBy(right, up, back) {
  state.eye.addScaledVector(axis(1, 0, 0), right).addScaledVector(axis(0, 1, 0), up).addScaledVector(axis(0, 0, 1), back);
  changed();
}

/* Goes nearer to what is looked at, or farther from it, by a factor. */
function dolly(factor) {
  state.eye.addScaledVector(axis(0, 0, -1), state.focus * (1 - factor));
  if (state.drag === "orbit") state.focus *= factor;
  changed();
}

/* ----------------------------------------------------------------------------------- marks */

/* Pixels of the canvas per pixel of the photograph, which is in its middle. */
function zoomOfStage() {
  return Math.min(stage.clientWidth / state.size[0], stage.clientHeight / state.size[1]);
}

/* The pixel of the photograph at a place of the window. */
function pixelAt({ clientX, clientY }) {
  const box = stage.getBoundingClientRect();
  const zoom = zoomOfStage();
  return [
    (clientX - box.left - box.width / 2) / zoom + state.size[0] / 2,
    (clientY - box.top - box.height / 2) / zoom + state.size[1] / 2,
  ];
}

function beginStroke(event) {
  const width = state.brush * Math.max(...state.size);
  strokes.push({ points: [pixelAt(event)], width, erases: state.erases });
  marked = placeOf();
  changed();
}

function extendStroke(event) {
  strokes.at(-1)?.points.push(pixelAt(event));
  changed();
}

/* Where the camera is: what is marked there is marked nowhere else. */
function placeOf() {
  return [...state.eye.toArray(), ...state.turn.toArray(), ...state.lens, ...state.size].join();
}

/* The mask of a size: transparent, and what is marked in a colour. */
function drawStrokes(colour) {
  const canvas = document.createElement("canvas");
  [canvas.width, canvas.height] = state.size;
  const pen = canvas.getContext("2d");
  Object.assign(pen, { lineCap: "round", lineJoin: "round", strokeStyle: colour });
  for (const { points, width, erases } of strokes) {
    pen.globalCompositeOperation = erases ? "destination-out" : "source-over";
    pen.lineWidth = width;
    pen.beginPath();
    pen.moveTo(...points[0]);
    // A line of no length is drawn as a dot by its round ends.
    for (const point of points) pen.lineTo(...point);
    pen.stroke();
  }
  return canvas;
}

function drawMarks() {
  if (strokes.length > 0 && placeOf() !== marked) {
    strokes = [];
    say("The camera moved, so nothing is marked any more.");
  }
  const canvas = byId("marks");
  const { clientWidth: width, clientHeight: height } = stage;
  Object.assign(canvas, { width, height });
  if (strokes.length === 0) return;
  const zoom = zoomOfStage();
  const [w, h] = [zoom * state.size[0], zoom * state.size[1]];
  const pen = canvas.getContext("2d");
  pen.drawImage(drawStrokes("#fff"), (width - w) / 2, (height - h) / 2, w, h);
  // Where strokes overlap, the colour is as transparent as anywhere else.
  pen.globalCompositeOperation = "source-in";
  pen.fillStyle = MARK_COLOUR;
  pen.fillRect(0, 0, width, height);
}

function undoStroke() {
  strokes.pop();
  changed();
}

function widen(factor) {
  state.brush = Math.min(WIDEST, Math.max(NARROWEST, state.brush * factor));
  byId("width").value = Math.log(state.brush / NARROWEST) / Math.log(WIDEST / NARROWEST);
}

function erase(erases) {
  state.erases = erases;
  byId("erase").setAttribute("aria-pressed", String(erases));
}

/* The mask as a PNG: white where something is marked, or null. */
async function maskPng() {
  if (strokes.length === 0) return null;
  const canvas = document.createElement("canvas");
  [canvas.width, canvas.height] = state.size;
  const pen = canvas.getContext("2d");
  pen.fillRect(0, 0, ...state.size);
  pen.drawImage(drawStrokes("#fff"), 0, 0);
  return new Promise((resolve) => { canvas.toBlob(resolve, "image/png"); });
}

/* The camera as a transforms.json with one frame, in the frame of the file and OpenGL axes. */
function cameraJson() {
  const { centre, unit } = content.frame;
  const axes = new THREE.Matrix4().makeRotationFromQuaternion(state.turn).elements;
  // The page is turned half about x: its y and z are those of the file, negated.
  const rows = [0, 1, 2].map((row) => {
    const sign = row === 0 ? 1 : -1;
    const place = centre[row] + sign * unit * state.eye.getComponent(row);
    return [...[0, 4, 8].map((column) => sign * axes[column + row]), place];
  });
  const [fl_x, fl_y, cx, cy] = state.lens;
  const [w, h] = state.size;
  const frame = { fl_x, fl_y, cx, cy, w, h, transform_matrix: [...rows, [0, 0, 0, 1]] };
  return `${JSON.stringify({ camera_model: "PINHOLE", frames: [frame] }, null, 1)}\n`;
}

function download(name, blob) {
  const anchor = document.createElement("a");
  anchor.href = URL.createObjectURL(blob);
  anchor.download = name;
  anchor.click();
  setTimeout(() => URL.revokeObjectURL(anchor.href), 10000);
}

function saveCamera() {
  download("camera.json", new Blob([cameraJson()], { type: "application/json" }));
  say("camera.json is where you stand: complete SPLAT --target camera.json --out OUT");
}

async function saveMask() {
  const png = await maskPng();
  if (!png) {
    say("Nothing is marked: choose Mark, and paint over what is wrong.");
    return;
  }
  download("mask.png", png);
  say("Save the camera, too, then: gscompleter repair SPLAT --camera camera.json --mask mask.png --out OUT");
}

/* -------------------------------------------------------------------------------- controls */

const choices = {
  mode: (mode) => { if (MODES.includes(mode) && content.layers.before) state.mode = mode; },
  generated: (how) => {
    if (!GENERATED.includes(how)) return;
    state.generated = how;
    for (const picture of pictures) picture.setGenerated(how);
  },
  drag: (drag) => {
    if (!DRAGS.includes(drag)) return;
    state.drag = drag;
    stage.dataset.drag = drag;
    byId("brush").hidden = drag !== "mark";
    // A single picture fills the stage, and is what is marked.
    if (drag === "mark" && ["side", "slider"].includes(state.mode)) choose("mode", "after");
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
  c: saveCamera,
  n: saveMask,
  z: undoStroke,
  ",": () => widen(1 / WIDENING),
  ".": () => widen(WIDENING),
  b: () => hold(true),
  r: () => goTo(state.shot),
  p: () => play(!state.playing),
  "[": () => step(-1),
  "]": () => step(1),
  "?": () => { byId("help").open = !byId("help").open; },
};

function onKeyDown(event) {
  if (event.ctrlKey || event.metaKey || event.altKey || !state.eye) return;
  if (event.target === byId("width") && event.key.startsWith("Arrow")) return;
  if (state.drag === "mark" && event.code === "KeyE") {
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
  if (state.drag === "mark" && pointers.size === 1) beginStroke(event);
}

/* One pointer turns or, with Shift or another button, moves; two move and change the distance. */
function onPointerMove(event) {
  const before = pointers.get(event.pointerId);
  if (!before) return;
  const now = { x: event.clientX, y: event.clientY };
  if (state.drag === "mark" && pointers.size === 1) {
    extendStroke(event);
    pointers.set(event.pointerId, now);
    return;
  }
  const share = 1 / (stage.clientHeight * pointers.size);
  const [right, down] = [(now.x - before.x) * share, (now.y - before.y) * share];
  if (pointers.size === 1 && !event.shiftKey && event.buttons === 1) {
    const sense = state.drag === "orbit" ? 1 : -1;
    turnBy(sense * right * TURN_BY_DRAG, sense * down * TURN_BY_DRAG, state.drag === "orbit");
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
  if (state.drag === "mark") widen(event.deltaY > 0 ? 1 / WIDENING : WIDENING);
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
  byId("save-camera").addEventListener("click", saveCamera);
  byId("save-mask").addEventListener("click", saveMask);
  for (const kind of Object.keys(choices)) {
    for (const button of document.querySelectorAll(`button[data-${kind}]`)) {
      button.addEventListener("click", () => choose(kind, button.dataset[kind]));
    }
  }
}

/* ------------------------------------------------------------------------- texts and links */

function say(text) {
  byId("message").textContent = text;
}

function tellShot(shot) {
  for (const button of byId("shots").children) {
    button.setAttribute("aria-current", String(button.dataset.shot === shot.name));
    if (button.dataset.shot === shot.name) button.scrollIntoView({ block: "nearest", inline: "nearest" });
  }
  byId("notes").textContent = shot.notes.join(" ");
  byId("notes").hidden = shot.notes.length === 0;
}

function shotButton(shot) {
  const button = document.createElement("button");
  button.type = "button";
  button.dataset.shot = shot.name;
  if (shot.thumbnail) {
    const image = document.createElement("img");
    image.src = `data:image/jpeg;base64,${shot.thumbnail}`;
    image.alt = "";
    button.append(image);
  }
  button.append(shot.title);
  button.addEventListener("click", () => goTo(shot.name));
  return button;
}

function writeTexts() {
  byId("title").textContent = content.title;
  byId("shots").append(...content.shots.map(shotButton));
  for (const [name, text] of Object.entries(content.licences)) {
    const licence = document.createElement("pre");
    licence.textContent = `${name}\n\n${text}`;
    byId("licences").append(licence);
  }
  byId("modes").hidden = !content.layers.before;
  byId("generated").hidden = !content.layers.generated;
}

/* The address tells what is looked at, so that it can be passed on. */
function link() {
  const words = new URLSearchParams({ camera: state.shot ?? "", mode: state.mode, generated: state.generated });
  history.replaceState(null, "", `#${words}`);
}

/* Does what the address says; false where it names no camera. */
function followLink() {
  const words = new URLSearchParams(location.hash.slice(1));
  const found = goTo(words.get("camera"));
  if (words.has("mode")) choose("mode", words.get("mode"));
  if (words.has("generated")) choose("generated", words.get("generated"));
  if (words.has("play")) play(true);
  return found;
}

function stats() {
  const { centre, unit } = content.frame;
  const [x, y, z] = state.eye.toArray();
  return {
    counts: content.counts,
    camera: state.shot,
    mode: state.mode,
    generated: state.generated,
    drag: state.drag,
    eye: [centre[0] + unit * x, centre[1] - unit * y, centre[2] - unit * z],
    seconds: state.seconds,
    playing: state.playing,
    frames,
  };
}

/* ----------------------------------------------------------------------------------- start */

async function start() {
  writeTexts();
  await importLibraries();
  state.up = upOfAll();
  makePath();
  byId("play").hidden = path.length < 2;
  pictures = [
    ...(content.layers.before ? [new Picture(byId("before"), ["before"])] : []),
    new Picture(byId("after"), ["observed", "generated"]),
  ];
  await Promise.all(pictures.map((picture) => picture.ready));
  listen();
  widen(1);
  if (!followLink()) goTo(content.shots[0].name);
  for (const kind of Object.keys(choices)) choose(kind, state[kind]);
  await settled();
  say("");
}

function fail(error) {
  const webgl = document.createElement("canvas").getContext("webgl2");
  say(webgl ? `The scene cannot be shown: ${error.message ?? error}.` : "This browser has no WebGL 2, which the scene needs.");
  throw error;
}

/* What other pages and tests may ask of this one. */
window.gsc = {
  ready: start().catch(fail),
  goTo,
  play,
  seek,
  setMode: (mode) => choose("mode", mode),
  setGenerated: (how) => choose("generated", how),
  cameraJson,
  maskPng,
  settled,
  stats,
};
