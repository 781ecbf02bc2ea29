// Sliders between two pictures, and pictures in full size from the folder of the page, once they are looked at.
"use strict";
for (const box of document.querySelectorAll(".pair")) {
  const slider = box.querySelector("input");
  const move = at => { slider.value = at; box.style.setProperty("--at", slider.value + "%"); };
  const follow = event => {
    const frame = box.getBoundingClientRect();
    move(100 * (event.clientX - frame.left) / frame.width);
  };
  slider.addEventListener("input", () => move(slider.value));
  box.addEventListener("pointerdown", event => {
    if (event.target !== slider) { box.setPointerCapture(event.pointerId); follow(event); }
  });
  box.addEventListener("pointermove", event => { if (box.hasPointerCapture(event.pointerId)) follow(event); });
}
const sharpen = new IntersectionObserver(seen => {
  for (const { target, isIntersecting } of seen) {
    if (!isIntersecting) continue;
    sharpen.unobserve(target);
    const full = new Image();   // where the folder is not there the small copy stays
    full.onload = () => { target.src = full.src; };
    full.src = target.dataset.full;
  }
}, { rootMargin: "200px" });
for (const picture of document.querySelectorAll("img[data-full]")) sharpen.observe(picture);
