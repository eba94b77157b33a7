"use strict";
for (const range of document.querySelectorAll(".compare input")) {
  const frame = range.closest(".frame");
  const show = () => frame.style.setProperty("--at", range.value + "%");
  range.addEventListener("input", show);
  show();
}
for (const space of document.querySelectorAll(".turning")) {
  const svg = space.querySelector("svg");
  const size = svg.viewBox.baseVal.width;
  const ranges = { yaw: space.querySelector(".yaw"), pitch: space.querySelector(".pitch") };
  const parts = [...svg.querySelectorAll("[data-points]")].map((part) => {
    const numbers = part.dataset.points.split(" ").map(Number);
    const points = [];
    for (let k = 0; k < numbers.length; k += 3) points.push(numbers.slice(k, k + 3));
    return { part, points };
  });
  const draw = () => {
    const [yaw, pitch] = [ranges.yaw, ranges.pitch].map((range) => (range.value * Math.PI) / 180);
    const project = ([x, y, z]) => {
      const toward = Math.cos(yaw) * z - Math.sin(yaw) * x;
      const across = Math.cos(yaw) * x + Math.sin(yaw) * z;
      const down = Math.sin(pitch) * toward - Math.cos(pitch) * y;
      return [across, down].map((value) => (size / 2 + size * 0.45 * value).toFixed(1));
    };
    for (const { part, points } of parts) {
      const drawn = points.map(project);
      if (part.tagName === "text") ["x", "y"].forEach((name, k) => part.setAttribute(name, drawn[0][k]));
      else part.setAttribute("points", drawn.map((point) => point.join(",")).join(" "));
    }
  };
  const stops = parts.filter(({ part }) => part.matches("polyline:is(.context, .anchor, .target)"));
  const flying = parts.find(({ part }) => part.matches(".flying"));
  const [button, ...names] = space.querySelectorAll("button");
  let [seconds, playing, before] = [0, false, 0];
  // From each camera to the next in 1.5 s, at rest at both, to the last one and back.
  const fly = () => {
    const end = stops.length - 1;
    const at = end - Math.abs(end - ((seconds / 1.5) % Math.max(2 * end, 1)));
    const k = Math.min(Math.floor(at), Math.max(end - 1, 0));
    const share = (at - k) ** 2 * (3 - 2 * (at - k));
    const to = stops[Math.min(k + 1, end)].points;
    flying.points = stops[k].points.map((point, i) => point.map((x, j) => x + share * (to[i][j] - x)));
    names.forEach((name, i) => name.setAttribute("aria-current", String(i === Math.round(at))));
    draw();
  };
  const play = (now) => {
    if (!playing) return;
    seconds += Math.min(Math.max(now - before, 0), 100) / 1000;
    before = now;
    fly();
    requestAnimationFrame(play);
  };
  const setPlaying = (value) => {
    [playing, before, button.textContent] = [value, performance.now(), value ? "Pause" : "Play"];
    fly();
    requestAnimationFrame(play);
  };
  button.addEventListener("click", () => setPlaying(!playing));
  names.forEach((name, i) => name.addEventListener("click", () => {
    seconds = 1.5 * i;
    setPlaying(false);
  }));
  fly();
  ranges.yaw.addEventListener("input", draw);
  ranges.pitch.addEventListener("input", draw);
  let last = null;
  svg.addEventListener("pointerdown", (event) => {
    last = [event.clientX, event.clientY];
    svg.setPointerCapture(event.pointerId);
  });
  svg.addEventListener("pointermove", (event) => {
    if (last === null) return;
    const moved = (value) => ((value + 540) % 360) - 180;
    ranges.yaw.value = moved(Number(ranges.yaw.value) + (event.clientX - last[0]) / 2);
    ranges.pitch.value = Number(ranges.pitch.value) + (event.clientY - last[1]) / 2;
    last = [event.clientX, event.clientY];
    draw();
  });
  for (const end of ["pointerup", "pointercancel"]) svg.addEventListener(end, () => (last = null));
}
