/* ---- camera: jumps, turns and moves ---- */

function goTo(name) {
  const shot = shotNamed.get(name);
  if (!shot) return false;
  play(false);
  state.seconds = path.find((stop) => stop.shot === shot).time;
  lookFrom(numbersOf(shot));
  Object.assign(state, { shot: name, framed: shot.framed });
  tellShot(shot);
  link();
  return true;
}

function step(by) {
  const names = content.shots.map((shot) => shot.name);
  const at = names.indexOf(state.shot);
  goTo(names[(at + by + names.length) % names.length]);
}

const axis = (x, y, z) => new THREE.Vector3(x, y, z).applyQuaternion(state.turn);

/* What is up: as the page was told, or for most cameras. */
function upOfAll() {
  if (content.up) return new THREE.Vector3(...content.up).normalize();
  const up = new THREE.Vector3();
  for (const shot of content.shots) up.add(new THREE.Vector3(shot.pose[1], shot.pose[5], shot.pose[9]));
  return up.lengthSq() > 0 ? up.normalize() : new THREE.Vector3(0, 1, 0);
}

/* Shows all that the window has room for, since the camera is no longer that of a photograph. */
function leaveFrame() {
  state.framed = false;
  changed();
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
  leaveFrame();
}

function moveBy(right, up, back) {
  state.eye.addScaledVector(axis(1, 0, 0), right).addScaledVector(axis(0, 1, 0), up).addScaledVector(axis(0, 0, 1), back);
  leaveFrame();
}

/* Goes nearer to what is looked at, or farther from it, by a factor. */
function dolly(factor) {
  state.eye.addScaledVector(axis(0, 0, -1), state.focus * (1 - factor));
  if (state.drag !== "fly") state.focus *= factor;
  leaveFrame();
}

