/* ---- connection: a live page asks the running program, and shows what changed ---- */

/* Actions on what is marked. */
const MARKING = ["repair", "remove", "fill"];
/* Actions that leave nothing of what is marked to be done. */
const FILLING = ["repair", "fill"];
const SILENT = "The program does not answer: it was ended, its machine sleeps, or it was started again and printed another address.";
/* This page among all that the program serves. */
const client = Math.random().toString(36).slice(2);
/* The latest message of the program: text, busy, revision, steps, undone, saved, camera, client. */
let latest = null;
/* The revision of the scene that is shown, 0 of which is the scene as it was given and as the page
   holds it, and what this page asked for last. */
let shownRevision = 0;
let asked = "";
let answered = () => {};
let isUpdating = false;

/* The address of a request, with the token that the program printed in that of the page. */
const addressOf = (path) => `${path}${location.search}`;

/* Begins to listen to the program. Resolves once its first message is shown. */
async function connect() {
  if (!content.live) return;
  listenToBox();
  for (const button of document.querySelectorAll("button[data-ask]")) {
    button.addEventListener("click", () => ask(button.dataset.ask));
  }
  const events = new EventSource(addressOf("/events"));
  const isHeard = new Promise((resolve) => {
    events.addEventListener("message", (event) => hear(JSON.parse(event.data)).then(resolve));
  });
  events.addEventListener("error", () => {
    say(SILENT);
    for (const button of document.querySelectorAll("button[data-ask]")) button.disabled = true;
  });
  await isHeard;
}

/* Shows what a message says. */
async function hear(message) {
  latest = message;
  showButtons(message);
  say(message.text);
  if (message.camera && message.client === client) goToFrame(message.camera);
  if (message.revision !== shownRevision && !isUpdating) await bringUpToDate();
  if (!message.busy && message.client === client) answered(message);
}

/* One thing is done at a time. */
function showButtons({ busy, steps, undone, saved }) {
  byId("unsaved").dataset.saved = String(saved);
  document.title = saved ? content.title : `• ${content.title}`;
  byId("live").setAttribute("aria-busy", String(busy));
  for (const button of document.querySelectorAll("button[data-ask]")) button.disabled = busy;
  byId("step-undo").disabled ||= steps === 0;
  byId("step-redo").disabled ||= undone === 0;
}

/* Shows the scene as it is now; a step that ends meanwhile is shown, too. */
async function bringUpToDate() {
  isUpdating = true;
  try {
    while (latest.revision !== shownRevision) shownRevision = await showDifference();
    // What was marked is done; after a removal its place may still be filled.
    if (latest.client === client && FILLING.includes(asked)) forgetStrokes();
    await settled();
    say(latest.text);
  } catch (error) {
    say(`The scene cannot be brought up to date: ${error.message ?? error}.`);
  } finally {
    isUpdating = false;
  }
}

/* Fetches what differs from the scene as it was given, and shows it. Returns its revision. */
async function showDifference() {
  const difference = await (await fetch(addressOf("/difference"))).json();
  const picture = pictures.at(-1);
  for (const { name, hidden } of difference.chunks) {
    if (picture.meshes[name] || hidden === null) continue;
    const answer = await fetch(addressOf(`/chunks/${name}`));
    await picture.add(name, new Uint8Array(await answer.arrayBuffer()));
  }
  // All at once: nothing is seen of a scene that is half changed.
  for (const { name, hidden } of difference.chunks) {
    if (picture.meshes[name]) picture.hide(name, hidden === null ? null : numbersIn(hidden));
  }
  changed();
  return difference.revision;
}

/* The unsigned numbers of 32 bits in base64. */
function numbersIn(text) {
  return new Uint32Array(Uint8Array.from(atob(text), (c) => c.charCodeAt(0)).buffer);
}

/* Asks the program for an action at the camera, with what is marked. Resolves to its last message
   once what it says is shown, or to null where it was not done. */
async function ask(action) {
  if (!content.live || !latest || latest.busy) return null;
  asked = action;
  const request = { action, client, camera: JSON.parse(cameraJson()) };
  if (action === "remove" && state.drag === "box") Object.assign(request, boxInScene());
  else if (MARKING.includes(action)) {
    const png = await maskPng();
    if (png) request.mask = await base64Of(png);
  }
  const isDone = new Promise((resolve) => { answered = resolve; });
  try {
    const headers = { "Content-Type": "application/json" };
    const answer = await fetch(addressOf("/do"), { method: "POST", headers, body: JSON.stringify(request) });
    if (answer.ok) return await isDone;
    say((await answer.json()).text);
  } catch {
    say(SILENT);
  }
  return null;
}

async function base64Of(blob) {
  const bytes = new Uint8Array(await blob.arrayBuffer());
  return btoa(Array.from(bytes, (byte) => String.fromCharCode(byte)).join(""));
}

/* Goes to a camera as transforms.json describes it, in the frame of the scene and OpenGL axes. */
function goToFrame({ fl_x, fl_y, cx, cy, w, h, transform_matrix }) {
  play(false);
  const { centre, unit } = content.frame;
  const pose = new THREE.Matrix4();
  // As in `cameraJson`, the other way.
  const rows = [0, 1, 2].map((row) => {
    const sign = row === 0 ? 1 : -1;
    const [x, y, z, place] = transform_matrix[row];
    return [sign * x, sign * y, sign * z, sign * (place - centre[row]) / unit];
  });
  pose.set(...rows.flat(), 0, 0, 0, 1);
  state.eye = new THREE.Vector3().setFromMatrixPosition(pose);
  state.turn = new THREE.Quaternion().setFromRotationMatrix(pose);
  Object.assign(state, { lens: [fl_x, fl_y, cx, cy], size: [w, h], framed: true });
  changed();
}

