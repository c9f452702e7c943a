// Arrow keys, Page Up and Down, Home and End turn to a slide; book.css shows the one in the address.
"use strict";
const slides = [...document.querySelectorAll(".slide h2")];
const keys = {
  ArrowRight: 1, ArrowDown: 1, PageDown: 1, ArrowLeft: -1, ArrowUp: -1, PageUp: -1,
  Home: -Infinity, End: Infinity,
};
function turn(by) {
  const place = slides.findIndex((slide) => `#${slide.id}` === location.hash) + by;
  location.replace(`#${slides[Math.min(Math.max(place, 0), slides.length - 1)].id}`);
}
addEventListener("keydown", (event) => {
  if (!(event.key in keys) || event.altKey || event.ctrlKey || event.metaKey) return;
  event.preventDefault();
  turn(keys[event.key]);
});
turn(0);
