const TAG = "setting:" // before the path of its setting in the tag of a widget

// Hear events of the whole page as long as a component is on it: type -> what is done.
function listen(model, heard, options = {}) {
  const stop = new AbortController()
  for (const [type, act] of Object.entries(heard)) document.addEventListener(type, act, {...options, signal: stop.signal})
  model.on("remove", () => stop.abort())
}

// What has the focus, in whatever shadow.
function focused() {
  let it = document.activeElement
  while (it?.shadowRoot?.activeElement) it = it.shadowRoot.activeElement
  return it
}

const TEXT = "[contenteditable], textarea, input:not([type=range], [type=checkbox], [type=radio], [type=button], [type=file])"

// The key that is pressed alone, where no text is typed.
function keyAlone(event) {
  const isOther = event.ctrlKey || event.metaKey || event.altKey || event.composedPath()[0].matches?.(TEXT)
  return isOther ? "" : event.key
}

const figureViews = () => [...Bokeh.index.query((it) => it.model.type === "Figure")]

// What the browser keeps under a name, null for nothing; with a value it keeps that. Some browsers refuse.
function kept(name, value, storage = "localStorage") {
  try {
    if (value === undefined) return window[storage].getItem(name)
    if (value === null) window[storage].removeItem(name)
    else window[storage].setItem(name, value)
  } catch { /* nothing is kept */ }
}
