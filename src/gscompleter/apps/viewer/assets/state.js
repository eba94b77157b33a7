"use strict";
/* The page's program, in files that share their names. One state, the same for both pictures: where
the camera is, its lens, what is compared. Whatever changes it calls `changed`, and both pictures are
drawn anew.

Positions and turns are in the page's frame (x right, y up, z back; see page.py). A lens is that of
a photograph: fx, fy, cx, cy in pixels of its size, the centre of the top-left one at (0.5, 0.5). */

const MODES = ["side", "slider", "before", "after"];
const GENERATED = ["show", "tint", "hide"];
const DRAGS = ["orbit", "fly", "mark", "lasso", "box"];
/* Ways to drag that paint, and the picture that stays as it is meanwhile. */
const PAINTS = ["mark", "lasso"];
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
const FRAME_COLOUR = "rgb(255 255 255 / 60%)";
/* How near to straight up or down one may look: the cosine. */
const STEEPEST = 0.995;

const content = JSON.parse(document.getElementById("content").textContent);
const shotNamed = new Map(content.shots.map((shot) => [shot.name, shot]));
const byId = (id) => document.getElementById(id);
const stage = byId("stage");

/* `framed` is true while nothing is shown beyond the photograph of the camera: from a jump to it until
   the camera is moved. What was completed ends at that frame. */
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
  framed: false,
  seconds: 0,
  playing: false,
  brush: 0.06,
  erases: false,
};
let THREE, SPARK, CONTROLS;
let pictures = [];
let path = [];
let frames = 0;
let pending = 0;
/* What is marked in the photograph of the camera `marked`: strokes of {points, width, erases, fills},
   in its pixels, and those that were taken back. */
let strokes = [];
let undoneStrokes = [];
let marked = "";

