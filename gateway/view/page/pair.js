// Two recordings beside each other: their playback is one, so whatever is pressed in one is done by both.

for (const scene of ["1", "2"]) {
  const query = new URLSearchParams(location.search);
  query.set("scene", scene);
  document.body.append(Object.assign(document.createElement("iframe"), { src: `/?${query}`, title: `recording ${scene}` }));
}
document.querySelector("iframe").addEventListener("load", event => event.target.focus()); // so that keys act at once
