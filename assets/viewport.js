// Tells how wide the window is when the page opens.

export function render({model}) {
  model.width_px = window.innerWidth
}
