// Stands below the results: tells how wide the window is when the page opens, and fades the results while they are
// stale. Fading them from here costs nothing; a change of their own style has the browser lay them all out anew.
// The theme is the system's, until another is chosen: that one is remembered.

const THEME = "wfsobs-theme"

function remembered() {
  const asked = new URLSearchParams(location.search).get("theme")
  try {
    return asked ?? localStorage.getItem(THEME)
  } catch {
    return asked
  }
}

function themes(model) {
  const system = matchMedia("(prefers-color-scheme: dark)")
  let wanted = false
  const follow = () => {
    const chosen = remembered()
    wanted = chosen ? chosen === "dark" : system.matches
    model.wants_dark = wanted
  }
  system.addEventListener("change", follow)
  model.on("remove", () => system.removeEventListener("change", follow))
  model.on("dark", () => {
    if (model.dark === wanted) return
    wanted = model.dark
    try {
      localStorage.setItem(THEME, wanted ? "dark" : "light")
    } catch { /* a browser that keeps nothing */ }
  })
  follow()
}

export function render({model, el}) {
  model.width_px = window.innerWidth
  themes(model)
  const fade = () => {
    const results = el.getRootNode().host?.previousElementSibling
    if (results) {
      results.style.transition = model.stale ? "opacity 0.2s 0.3s" : "opacity 0.1s"
      results.style.opacity = model.stale ? "0.45" : "1"
    }
  }
  model.on("stale", fade)
}
