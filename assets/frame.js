// Stands below the results: tells how wide the window is when the page opens, and fades the results while they are
// stale. Fading them from here costs nothing; a change of their own style has the browser lay them all out anew.

export function render({model, el}) {
  model.width_px = window.innerWidth
  const fade = () => {
    const results = el.getRootNode().host?.previousElementSibling
    if (results) {
      results.style.transition = model.stale ? "opacity 0.2s 0.3s" : "opacity 0.1s"
      results.style.opacity = model.stale ? "0.45" : "1"
    }
  }
  model.on("stale", fade)
}
