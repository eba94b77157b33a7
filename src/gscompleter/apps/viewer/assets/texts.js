/* ---- texts and links ---- */

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
  byId("generated").hidden = !content.layers.generated && !content.live;
  for (const part of document.querySelectorAll(".live")) part.hidden = !content.live;
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

/* Gaussians of each layer: those of the page, and in `live` those that are shown after the steps. */
function countGaussians() {
  const counts = { ...content.counts };
  if (!content.live) return counts;
  const meshes = Object.entries(pictures.at(-1).meshes);
  const left = (mesh) => (mesh.isGone ? 0 : mesh.extSplats.numSplats - mesh.opacities.size);
  for (const layer of ["observed", "generated"]) {
    const own = meshes.filter(([name]) => (name === "observed") === (layer === "observed"));
    counts[layer] = own.reduce((sum, [, mesh]) => sum + left(mesh), 0);
  }
  return counts;
}

function stats() {
  const { centre, unit } = content.frame;
  const [x, y, z] = state.eye.toArray();
  return {
    counts: countGaussians(),
    camera: state.shot,
    mode: state.mode,
    generated: state.generated,
    drag: state.drag,
    framed: state.framed,
    strokes: strokes.length,
    live: latest,
    chunks: Object.keys(pictures.at(-1).meshes),
    eye: [centre[0] + unit * x, centre[1] - unit * y, centre[2] - unit * z],
    seconds: state.seconds,
    playing: state.playing,
    frames,
  };
}

