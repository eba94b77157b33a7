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
  draw();
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
