/* ---- saving: mask and camera as files ---- */

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
    say("Nothing is marked: choose Brush or Lasso, and paint over what is wrong.");
    return;
  }
  download("mask.png", png);
  say("Save the camera, too, then: gscompleter repair SPLAT --target camera.json --mask mask.png --out OUT");
}

