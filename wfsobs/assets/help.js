// The help at the top right: a tour, shortcuts and words, by button or by the key "?"; offered once.

const TOLD = "wfsobs-tour" // whether somebody has been here with this browser

export function render({model, el}) {
  el.innerHTML = model.html
  const [open, sheet, offer] = [".open", "#help", "#offer"].map((it) => el.querySelector(it))
  offer.onclick = () => offer.hidePopover()
  sheet.onbeforetoggle = () => { if (sheet.matches(":focus-within")) open.focus() }  // the browser knows the host of the shadow alone
  if (kept(TOLD) === null) setTimeout(() => {
    if (!el.isConnected) return
    kept(TOLD, "offered")
    offer.showPopover()
  }, 2000)
  listen(model, {keydown: (event) => { if (keyAlone(event) === "?") sheet.togglePopover() }})
}
