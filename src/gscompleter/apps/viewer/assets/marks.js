/* ---- marks: what is painted on the picture at the current camera ---- */

/* Pixels of the canvas per pixel of the photograph, which is in its middle. */
function zoomOfStage() {
  return zoomToFit(state.size, stage.clientWidth, stage.clientHeight);
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
  strokes.push({ points: [pixelAt(event)], width, erases: state.erases, fills: state.drag === "lasso" });
  undoneStrokes = [];
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
  Object.assign(pen, { lineCap: "round", lineJoin: "round", strokeStyle: colour, fillStyle: colour });
  for (const { points, width, erases, fills } of strokes) {
    pen.globalCompositeOperation = erases ? "destination-out" : "source-over";
    pen.lineWidth = width;
    pen.beginPath();
    pen.moveTo(...points[0]);
    // A line of no length is drawn as a dot by its round ends.
    for (const point of points) pen.lineTo(...point);
    if (fills) pen.fill();
    else pen.stroke();
  }
  return canvas;
}

function drawMarks() {
  if (strokes.length > 0 && placeOf() !== marked) {
    forgetStrokes();
    say("The camera moved, so nothing is marked any more.");
  }
  const canvas = byId("marks");
  const { clientWidth: width, clientHeight: height } = stage;
  Object.assign(canvas, { width, height });
  const zoom = zoomOfStage();
  const [w, h] = [zoom * state.size[0], zoom * state.size[1]];
  const pen = canvas.getContext("2d");
  if (strokes.length === 0) {
    drawFrame(pen, (width - w) / 2, (height - h) / 2, w, h);
    return;
  }
  pen.drawImage(drawStrokes("#fff"), (width - w) / 2, (height - h) / 2, w, h);
  // Where strokes overlap, the colour is as transparent as anywhere else.
  pen.globalCompositeOperation = "source-in";
  pen.fillStyle = MARK_COLOUR;
  pen.fillRect(0, 0, width, height);
  pen.globalCompositeOperation = "source-over";
  drawFrame(pen, (width - w) / 2, (height - h) / 2, w, h);
}

/* Draws the border of the photograph, where it is what is painted on or completed. */
function drawFrame(pen, left, top, width, height) {
  // Two pictures side by side have a photograph each.
  if (state.mode === "side" && !state.held) return;
  if (!content.live && !PAINTS.includes(state.drag)) return;
  pen.strokeStyle = FRAME_COLOUR;
  pen.strokeRect(left + 0.5, top + 0.5, width - 1, height - 1);
}

function undoStroke() {
  if (strokes.length > 0) undoneStrokes.push(strokes.pop());
  changed();
}

function redoStroke() {
  if (undoneStrokes.length > 0) strokes.push(undoneStrokes.pop());
  changed();
}

function forgetStrokes() {
  strokes = [];
  undoneStrokes = [];
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

