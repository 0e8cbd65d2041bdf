// The presets with a line and a picture each: the lines of their vibration over frequency, and whether anything happens.

const LOW = 3, HIGH = 150 // of the pictures [Hz]
const WIDE = 132, TALL = 44

export function render({model, el}) {
  const open = document.createElement("button")
  Object.assign(open, {type: "button", className: "open", textContent: "Gallery"})
  const sheet = document.createElement("div")
  Object.assign(sheet, {className: "sheet", popover: "auto"})
  sheet.setAttribute("role", "dialog")
  sheet.setAttribute("aria-label", "Gallery of presets")
  open.popoverTargetElement = sheet
  el.append(open, sheet)

  const draw = () => {
    sheet.replaceChildren(...model.items.map((item) => {
      const card = document.createElement("button")
      Object.assign(card, {type: "button", className: "preset", innerHTML: picture(item)})
      const title = document.createElement("strong")
      title.textContent = item.title
      const line = document.createElement("span")
      line.textContent = item.line
      card.append(title, line)
      card.onclick = () => { sheet.hidePopover(); open.focus(); model.send_msg({choose: item.name}) }
      return card
    }))
    if (sheet.matches(":popover-open")) sheet.querySelector("button")?.focus()
  }
  sheet.addEventListener("beforetoggle", (event) => {
    if (event.newState !== "open") return
    paint(sheet)
    model.send_msg({open: true})
  })
  sheet.addEventListener("toggle", (event) => { if (event.newState === "open") sheet.querySelector("button")?.focus() })
  model.on("items", draw)
}

function picture(item) {
  const x = (f) => 4 + (WIDE - 8) * Math.log(f / LOW) / Math.log(HIGH / LOW)
  const most = Math.max(...item.peaks.map(([, rms]) => rms), 1e-9)
  const stems = item.peaks.filter(([f]) => f >= LOW && f <= HIGH)
    .map(([f, rms]) => `<path d="M${x(f).toFixed(1)} ${TALL - 4}V${(TALL - 4 - (TALL - 10) * Math.sqrt(rms / most)).toFixed(1)}"/>`)
  const event = item.events ? `<path class="event" d="M${WIDE - 10} 4V${TALL - 4}"/>` : ""
  return `<svg width="${WIDE}" height="${TALL}" viewBox="0 0 ${WIDE} ${TALL}" aria-hidden="true">` +
    `<path class="axis" d="M2 ${TALL - 4}H${WIDE - 2}"/>${stems.join("")}${event}</svg>`
}
