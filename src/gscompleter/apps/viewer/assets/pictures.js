/* ---- pictures: canvases, and the layers of Gaussians that they show ---- */

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
      this.add(name, bytesOf(content.layers[name]));
    }
  }

  /* Adds Gaussians, the bytes of a .spz. Resolves once they can be drawn. */
  add(name, fileBytes) {
    const mesh = new SPARK.SplatMesh({ fileBytes, fileType: SPARK.SplatFileType.SPZ, extSplats: true });
    this.meshes[name] = mesh;
    // The opacity, as it is stored, of each Gaussian that is hidden, by its number.
    mesh.opacities = new Map();
    mesh.isGone = false;
    this.scene.add(mesh);
    this.setGenerated(state.generated);
    return mesh.initialized;
  }

  /* Hides Gaussians by their numbers, or all with null; those that were hidden before come back. */
  hide(name, numbers) {
    const mesh = this.meshes[name];
    mesh.isGone = numbers === null;
    if (numbers !== null) {
      const { extArrays: [packed], textures: [texture] } = mesh.extSplats;
      // The fourth word of a Gaussian is its opacity alone.
      for (const [number, opacity] of mesh.opacities) packed[4 * number + 3] = opacity;
      mesh.opacities = new Map(Array.from(numbers, (number) => [number, packed[4 * number + 3]]));
      for (const number of numbers) packed[4 * number + 3] = 0;
      texture.needsUpdate = true;
      mesh.updateVersion();
    }
    this.setGenerated(state.generated);
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
    this.canvas.style.clipPath = state.framed ? clipToFrame(state.size, width, height) : "none";
    this.renderer.render(this.scene, this.camera);
    this.stale = true;
    if (!this.updating) this.update();
  }

  place(width, height) {
    const { camera } = this;
    camera.near = NEAR;
    // Only the handles of the box read it, for their size.
    camera.fov = 2 * Math.atan(state.size[1] / 2 / state.lens[1]) * 180 / Math.PI;
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
    for (const [name, mesh] of Object.entries(this.meshes)) {
      const isGenerated = !["before", "observed"].includes(name);
      mesh.visible = !mesh.isGone && !(isGenerated && how === "hide");
      mesh.recolor.setRGB(...(isGenerated && how === "tint" ? TINT : [1, 1, 1]));
    }
  }
}

/* Pixels of a canvas for each one of the photograph, all of which it shows. */
function zoomToFit([photoWidth, photoHeight], width, height) {
  return Math.min(width / photoWidth, height / photoHeight);
}

/* The CSS that cuts a canvas down to the photograph in its middle. */
function clipToFrame([photoWidth, photoHeight], width, height) {
  const zoom = zoomToFit([photoWidth, photoHeight], width, height);
  return `inset(${(height - zoom * photoHeight) / 2}px ${(width - zoom * photoWidth) / 2}px)`;
}

/* The projection of a lens onto a canvas that shows the whole photograph, in its middle. */
function projection([fx, fy, cx, cy], [photoWidth, photoHeight], width, height) {
  const zoom = zoomToFit([photoWidth, photoHeight], width, height);
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
  stage.classList.toggle("framed", state.framed);
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

