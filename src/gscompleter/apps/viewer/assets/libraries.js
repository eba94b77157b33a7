/* ---- libraries: modules and bytes that the page brings ---- */

/* Imports the modules that the page brings, from addresses of its own memory. */
async function importLibraries() {
  const imports = {};
  for (const [name, text] of Object.entries(content.modules)) {
    imports[name] = URL.createObjectURL(new Blob([text], { type: "text/javascript" }));
  }
  const map = document.createElement("script");
  map.type = "importmap";
  map.textContent = JSON.stringify({ imports });
  document.head.append(map);
  THREE = await import("three");
  SPARK = await import("@sparkjsdev/spark");
  if (content.live) CONTROLS = await import("three/addons/controls/TransformControls.js");
}

/* The bytes of a source, put together from its parts. */
function bytesOf(name) {
  const parts = (gscSources[name] ?? []).map((text) => Uint8Array.from(atob(text), (c) => c.charCodeAt(0)));
  const bytes = new Uint8Array(parts.reduce((length, part) => length + part.length, 0));
  let end = 0;
  for (const part of parts) {
    bytes.set(part, end);
    end += part.length;
  }
  return bytes;
}

