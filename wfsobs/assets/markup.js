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
