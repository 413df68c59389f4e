"use strict";
// Tiles of a map that is served: each is loaded when it is shown. The browser unpacks it.
window.loadTile = async key => {
  const answer = await fetch(`tiles/${key}`);
  if (!answer.ok) throw new Error(await answer.text());
  return new Uint8Array(await answer.arrayBuffer());
};
