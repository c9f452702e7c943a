// Shows the optimum behind the sliders of each panel; sliders.py has proved and drawn them all.
"use strict";
for (const panel of document.querySelectorAll(".panel")) {
  const find = (name) => panel.querySelector(name);
  const { sliders, frames } = JSON.parse(find("script").textContent);
  const inputs = [...panel.querySelectorAll("input")], button = find("button");
  const shown = find("svg").getAttribute("aria-label");

  function show() {
    let place = 0;
    const said = inputs.map((input, k) => {
      const [name, values] = sliders[k], value = values[input.value];
      place = place * values.length + Number(input.value);
      input.nextElementSibling.textContent = value;
      input.setAttribute("aria-valuetext", value);
      return `${name} ${value}`;
    });
    const { picture, facts } = frames[place];
    const pairs = Object.entries(facts).map(([name, value]) =>
      `<div><dt>${name}</dt><dd>${value}</dd></div>`);
    find(".moving").innerHTML = picture;
    find("output").innerHTML = `<dl>${pairs.join("")}</dl>`;
    find("svg").setAttribute("aria-label", `${shown}, at ${said.join(", ")}; in numbers below`);
  }
  for (const input of inputs) input.addEventListener("input", show);
  button.addEventListener("click", () => {
    button.setAttribute("aria-expanded", find(".table").classList.toggle("open"));
  });
  panel.classList.add("live"); // until then, only the table is seen
  show();
}
