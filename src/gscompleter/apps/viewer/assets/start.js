/* ---- start ---- */

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
  await connect();
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
  ask,
  placeBox,
};

