/* ---- path: a flight through the cameras ---- */

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
  Object.assign(state, { seconds, shot: shot.name, framed: true });
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

