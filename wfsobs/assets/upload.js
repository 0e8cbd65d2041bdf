// Loading a file: the sheet, the file sent in parts, and what there is to say about it.

async function send(model, file) {
  const {name, size} = file
  if (/\.toml$/i.test(name) && size <= model.part) return model.send_msg({action: "scenario", name, text: await file.text()})
  if (size > model.largest) return model.send_msg({action: "large", name})
  const count = Math.max(1, Math.ceil(size / model.part))
  for (let index = 0; index < count; index++) {
    const data = await file.slice(index * model.part, (index + 1) * model.part).arrayBuffer()
    model.send_msg({action: "part", name, index, count, data})
  }
}

export function render({model, el}) {
  const place = () => { el.style.position = model.source_title || model.message ? "" : "absolute" }
  showMarkup(el, model, place)
  model.on(["source_title", "message"], place)  // which come one after the other
  const [input, sheet, pick] = ["input", "#load", ".pick"].map((it) => el.querySelector(it))
  const take = ([file]) => { if (file) send(model, file) }
  pick.onclick = () => input.click()
  input.onchange = () => { take(input.files); input.value = "" }

  // A file may be dropped anywhere.
  const over = (event) => {
    if (!event.dataTransfer?.types.includes("Files")) return
    event.preventDefault()
    if (event.type === "drop") take(event.dataTransfer.files)
  }
  listen(model, {
    dragover: over, dragenter: over, drop: over,
    "wfsobs:load": () => { input.accept = input.dataset.records; sheet.showPopover() },
    "wfsobs:open": () => { input.accept = ".toml,.wfsobs-session"; input.click() },
  })
}
