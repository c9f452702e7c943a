// One figure at a time; arrow keys, Page Up and Down, Home and End turn.  Without it, all are seen.
"use strict";
(() => {
  const slides = [...document.querySelectorAll(".slide")];
  const count = document.querySelector(".turner output");
  let here = 0;

  const show = (place) => {
    here = Math.min(Math.max(place, 0), slides.length - 1);
    slides.forEach((slide, k) => slide.classList.toggle("now", k === here));
    count.textContent = `${here + 1} of ${slides.length}`;
    history.replaceState(null, "", `#${slides[here].id}`); // so that a reload stays here
  };
  const turn = (place) => {
    show(place);
    slides[here].querySelector("h2").focus(); // a screen reader goes on from the title
  };
  const linked = () => slides.findIndex((slide) => `#${slide.id}` === location.hash);
  const keys = {
    ArrowRight: () => here + 1, ArrowDown: () => here + 1, PageDown: () => here + 1,
    ArrowLeft: () => here - 1, ArrowUp: () => here - 1, PageUp: () => here - 1,
    Home: () => 0, End: () => slides.length - 1,
  };
  addEventListener("keydown", (event) => {
    if (event.altKey || event.ctrlKey || event.metaKey || !keys[event.key]) return;
    event.preventDefault();
    turn(keys[event.key]());
  });
  addEventListener("hashchange", () => { if (linked() >= 0) turn(linked()); });
  const [back, on] = document.querySelectorAll(".turner button");
  back.addEventListener("click", () => show(here - 1));
  on.addEventListener("click", () => show(here + 1));
  document.body.classList.add("talk");
  show(Math.max(linked(), 0));
})();
