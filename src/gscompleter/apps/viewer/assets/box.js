/* ---- box: whatever it contains can be removed, in a live page ---- */

const HANDLES = ["translate", "rotate", "scale"];
const BOX_COLOUR = 0xff5050;
const SIDES = ["x", "y", "z"];
/* The box as a mesh of three.js, with the sizes of its sides as scale, and its handles. */
let box = null;
let handles = null;

/* Makes the box, where the camera looks. */
function makeBox() {
  const picture = pictures.at(-1);
  const edges = new THREE.EdgesGeometry(new THREE.BoxGeometry(1, 1, 1));
  const material = new THREE.LineBasicMaterial({ color: BOX_COLOUR, depthTest: false, transparent: true });
  box = new THREE.LineSegments(edges, material);
  box.position.copy(state.eye).addScaledVector(axis(0, 0, -1), state.focus);
  box.scale.setScalar(state.focus / 4);
  handles = new CONTROLS.TransformControls(picture.camera, stage);
  handles.attach(box);
  handles.addEventListener("change", changed);
  handles.addEventListener("objectChange", tellSize);
  const shown = handles.getHelper();
  picture.scene.add(box, shown);
  // Over the Gaussians, wherever they are.
  for (const object of [box, shown]) object.traverse((part) => { part.renderOrder = 10; });
  tellSize();
}

function showBox(shown) {
  byId("box").hidden = !shown;
  if (!box && !shown) return;
  if (!box) makeBox();
  box.visible = shown;
  handles.enabled = shown;
  handles.getHelper().visible = shown;
  setHandles(handles.mode);
  changed();
}

/* True while a handle is dragged, and the camera stays. */
function isBoxDragged() {
  return handles !== null && handles.dragging;
}

function setHandles(mode) {
  handles.setMode(mode);
  // A box has the axes of its own rotation, as its sizes do.
  handles.setSpace(mode === "translate" ? "world" : "local");
  for (const button of document.querySelectorAll("button[data-handles]")) {
    button.setAttribute("aria-pressed", String(button.dataset.handles === mode));
  }
}

function nextHandles() {
  if (state.drag === "box") setHandles(HANDLES[(HANDLES.indexOf(handles.mode) + 1) % HANDLES.length]);
}

/* Writes the sizes of the sides, in the unit of the scene. */
function tellSize() {
  for (const side of SIDES) byId(`size-${side}`).value = Number((Math.abs(box.scale[side]) * content.frame.unit).toPrecision(4));
}

function readSize(side) {
  const size = byId(`size-${side}`).valueAsNumber;
  if (size > 0) box.scale[side] = size / content.frame.unit;
  changed();
}

/* Puts the box where the scene has these corners: smallest x, y and z, then largest. */
function placeBox(corners) {
  choose("drag", "box");
  const { centre, unit } = content.frame;
  const [low, high] = [corners.slice(0, 3), corners.slice(3)];
  SIDES.forEach((side, i) => {
    const sign = i === 0 ? 1 : -1;
    box.position[side] = sign * ((low[i] + high[i]) / 2 - centre[i]) / unit;
    box.scale[side] = (high[i] - low[i]) / unit;
  });
  box.quaternion.identity();
  tellSize();
  changed();
}

/* The box in the frame of the scene, as `remove --box` and `--box-rotation` have it. */
function boxInScene() {
  const { centre, unit } = content.frame;
  // The page is turned half about x: its y and z are those of the scene, negated.
  const middle = SIDES.map((side, i) => centre[i] + (i === 0 ? 1 : -1) * unit * box.position[side]);
  const half = SIDES.map((side) => Math.abs(box.scale[side]) * unit / 2);
  const { w, x, y, z } = box.quaternion;
  return {
    box: [...middle.map((value, i) => value - half[i]), ...middle.map((value, i) => value + half[i])],
    box_rotation: [w, x, -y, -z],
  };
}

function listenToBox() {
  for (const side of SIDES) byId(`size-${side}`).addEventListener("input", () => readSize(side));
  for (const button of document.querySelectorAll("button[data-handles]")) {
    button.addEventListener("click", () => setHandles(button.dataset.handles));
  }
}

