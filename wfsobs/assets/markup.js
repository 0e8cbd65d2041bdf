// Bring what stands in an element to what is to stand there; what is the same keeps its focus, its popover and a click under way.
function patch(element, wanted) {
  wanted.forEach((to, i) => {
    const at = element.childNodes[i]
    if (!at) element.append(to)
    else if (at.nodeName !== to.nodeName) at.replaceWith(to)
    else if (at.nodeType !== Node.ELEMENT_NODE) { if (at.data !== to.data) at.data = to.data }
    else {
      for (const {name} of [...at.attributes]) if (!to.hasAttribute(name)) at.removeAttribute(name)
      for (const {name, value} of to.attributes) if (at.getAttribute(name) !== value) at.setAttribute(name, value)
      patch(at, [...to.childNodes])
    }
  })
  while (element.childNodes.length > wanted.length) element.lastChild.remove()
}

function patchHtml(element, html) {
  const wanted = document.createElement("div")
  wanted.innerHTML = html
  patch(element, [...wanted.childNodes])
}

// HTML of the server, in place; what is pressed or changed in it is told by its name (data-do) and its row (data-key).

function setMarkup(root, html) {
  patchHtml(root, html)
  for (const it of root.querySelectorAll("time")) it.textContent = when(it.dataset.seconds)
  for (const it of root.querySelectorAll(":is(input, select)[data-do]")) {  // what was typed, ticked or chosen is no attribute
    const key = keyOf(it)
    const isBeingTyped = it === root.getRootNode().activeElement && it.key === key && it.value !== it.known
    if (it.type === "checkbox") it.checked = it.hasAttribute("checked")
    else if (!isBeingTyped) it.known = it.value = it.getAttribute("value") ?? it.querySelector("[selected]").value
    it.key = key
  }
}

const keyOf = (it) => it.closest("[data-key]")?.dataset.key ?? ""

function when(seconds) {
  const at = new Date(seconds * 1000), today = at.toDateString() === new Date().toDateString()
  return today ? at.toLocaleTimeString() : at.toLocaleString()
}

function tellActions(root, model) {
  const tell = (event) => {
    const it = event.target.closest("[data-do]"), isField = it?.matches("input, select")
    if (!it || isField !== (event.type === "change")) return
    it.known = it.value
    model.send_msg({action: it.dataset.do, key: keyOf(it), name: it.value, on: it.checked ?? false})
  }
  root.addEventListener("click", tell)
  root.addEventListener("change", tell)
}

// Draw the HTML of a component whenever it changes, and tell what is done in it.
function showMarkup(root, model, drawn = () => {}) {
  const draw = () => {
    setMarkup(root, model.html)
    drawn()
  }
  tellActions(root, model)
  model.on("html", draw)
  draw()
}
