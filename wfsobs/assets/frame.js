// Stands below the results: closes the drawer of a phone, tells when the first picture stands, and fades stale results, which costs
// nothing from here; a change of their own style has the browser lay them all out anew.

const THEME = "wfsobs-theme"

// The theme is the system's, until another is chosen: that one is remembered.
function themes(model) {
  const system = matchMedia("(prefers-color-scheme: dark)")
  const follow = () => {
    const chosen = new URLSearchParams(location.search).get("theme") ?? kept(THEME)
    model.wants_dark = chosen ? chosen === "dark" : system.matches
  }
  system.addEventListener("change", follow)
  model.on("remove", () => system.removeEventListener("change", follow))
  model.on("preferred_theme", () => kept(THEME, model.preferred_theme))
  follow()
}

// A React component gives what the server sets back to its model a moment later, which would undo what is newer by then. It is
// left out.
const ECHO_MS = 2000
function ignoreEchoes({model: {data}}) {
  if (!data || Object.hasOwn(data, "setv")) return
  const {setv} = data
  let given = []  // {name, value, at}
  data.setv = function (changes, options = {}) {
    given = given.filter(({at}) => performance.now() - at < ECHO_MS)
    const [[name, value] = [], ...more] = Object.entries(changes)
    const which = options.sync === false || more.length ? -1 : given.findIndex((it) => it.name === name && it.value === value)
    if (which >= 0) return given = given.filter((it, i) => it.name !== name || i > which)
    setv.call(this, changes, options)
    if (options.sync !== false) given = given.filter((it) => !(it.name in changes))
    else for (const name in changes) given.push({name, value: this.attributes[name], at: performance.now()})
  }
}
function ignoreAllEchoes() {
  const type = "panel.models.esm.ReactComponent", kind = Bokeh.Models.get(type).prototype.default_view.prototype, {initialize} = kind
  if (kind.ignoresEchoes) return
  kind.ignoresEchoes = true
  kind.initialize = function () {
    initialize.call(this)
    ignoreEchoes(this)
  }
  for (const view of Bokeh.index.query((it) => it.model.type === type)) ignoreEchoes(view)
}
ignoreAllEchoes()

// What the first picture does not need is made once its figures have been painted, or a page has none. It is told until it has
// come: what is told while a connection breaks is lost.
const PATIENCE = 1500, STEP = 30, AGAIN = 3000
function tellDrawn(model) {
  const end = performance.now() + PATIENCE
  const tell = () => {
    if (model.complete) return
    model.send_msg({drawn: true})
    setTimeout(tell, AGAIN)
  }
  const idle = window.requestIdleCallback ?? ((act) => setTimeout(act, STEP))
  const look = () => {
    const figures = figureViews()
    const drawn = figures.length > 0 && figures.every((it) => it.has_finished())
    if (drawn || performance.now() > end) idle(tell, {timeout: PATIENCE})
    else setTimeout(look, STEP)
  }
  look()
}

// In a narrow window the drawer lies over the page, hidden until it has been closed here and is opened.
const NARROW = "(max-width: 999.95px)"
function closeDrawer(doc) {
  const page = [...doc.all_models].find((it) => it.data?.attributes && "sidebar_open" in it.data.attributes)
  const allow = () => document.documentElement.style.setProperty("--wfsobs-drawer", "visible")
  if (!page || !matchMedia(NARROW).matches) return allow()
  page.data.sidebar_open = false
  page.data.properties.sidebar_open.change.connect(allow)
}

export function render({model, view, el}) {
  closeDrawer(view.model.document)
  themes(model)
  tellDrawn(model)
  const fade = () => {
    const results = el.getRootNode().host?.previousElementSibling
    if (results) {
      // Not within a second: without a graphics card each frame of that draws all results.
      results.style.transition = model.stale ? "opacity 0.2s 1s" : "none"
      results.style.opacity = model.stale ? "0.45" : "1"
    }
  }
  model.on("stale", fade)
  const shade = () => { document.documentElement.style.colorScheme = model.dark ? "dark" : "light" }
  model.on("dark", shade)
  shade()
}
