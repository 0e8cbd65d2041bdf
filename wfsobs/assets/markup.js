// HTML of the server, brought up to date in place; what is pressed or changed in it is told by its name: data-do, and of which row.

function setMarkup(root, html) {
  const wanted = document.createElement("div")
  wanted.innerHTML = html
  for (const it of wanted.querySelectorAll("time")) it.textContent = when(it.dataset.seconds)
  patch(root, [...wanted.childNodes])
  for (const it of root.querySelectorAll("input[data-do]")) {  // what was typed or ticked is no attribute
    const key = keyOf(it)
    if (it.type === "text" && (it !== root.getRootNode().activeElement || it.key !== key)) it.value = it.getAttribute("value")
    it.checked = it.hasAttribute("checked")
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
    const it = event.target.closest("[data-do]"), isInput = it?.matches("input")
    if (it && isInput === (event.type === "change")) model.send_msg({action: it.dataset.do, key: keyOf(it), name: it.value, on: it.checked ?? false})
  }
  root.addEventListener("click", tell)
  root.addEventListener("change", tell)
}
