// A table of numbers edited in place. The Tab key stops at the cells of one line, the arrow keys lead to the others.

export function render({model, el}) {
  let current = 0  // the line at which Tab stops
  let next = null  // which element gets the focus when the rows have changed
  const lines = () => [...el.querySelectorAll("tr[data-key], fieldset")]
  const cells = (line) => [...line.querySelectorAll("[data-cell]")]

  const turn = (to) => {
    current = Math.max(0, Math.min(to, lines().length - 1))
    const isTable = el.querySelector("table") !== null
    lines().forEach((line, i) => {
      for (const it of line.querySelectorAll("[data-do]")) it.tabIndex = isTable && i !== current ? -1 : 0
    })
  }
  el.addEventListener("click", ({target}) => {
    const does = target.closest("[data-do]")?.dataset.do, at = lines().indexOf(target.closest("tr, fieldset")), n = lines().length
    if (does === "add") next = () => cells(lines()[n] ?? el)[0]
    if (does === "remove") next = () => lines()[Math.min(at, n - 2)]?.querySelector("[data-do=remove]") ?? el.querySelector(".add")
  })
  el.addEventListener("focusin", ({target}) => {
    const at = lines().indexOf(target.closest("tr, fieldset"))
    if (at >= 0 && at !== current) turn(at)
  })
  el.addEventListener("keydown", (event) => {
    const line = event.target.closest("tr"), step = {ArrowDown: 1, ArrowUp: -1}[event.key]
    const to = lines()[lines().indexOf(line) + step]
    if (!line || !to || event.target.matches("select")) return
    event.preventDefault()
    cells(to)[Math.max(0, cells(line).indexOf(event.target))].focus()
  })
  showMarkup(el, model, () => {
    turn(current)
    next?.()?.focus()
    next = null
  })
}
