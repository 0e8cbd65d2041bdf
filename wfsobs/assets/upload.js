// Loading a record: the button, the file sent in parts, and what there is to say about it.

async function base64(blob) {
  const bytes = new Uint8Array(await blob.arrayBuffer())
  let text = ""
  for (let i = 0; i < bytes.length; i += 32_768) text += String.fromCharCode(...bytes.subarray(i, i + 32_768))
  return btoa(text)
}

async function send(model, file) {
  if (file.size > model.largest) return model.send_msg({action: "large", name: file.name})
  const count = Math.max(1, Math.ceil(file.size / model.part))
  for (let index = 0; index < count; index++) {
    const data = await base64(file.slice(index * model.part, (index + 1) * model.part))
    model.send_msg({action: "part", name: file.name, index, count, data})
  }
}

export function render({model, el}) {
  const bar = document.createElement("div")
  bar.className = "bar"
  const input = Object.assign(document.createElement("input"), {type: "file", hidden: true, accept: ".npz,.csv,.txt,.fits,.fit,.fts"})
  input.setAttribute("aria-label", "Record file")
  input.onchange = () => {
    if (input.files[0]) send(model, input.files[0])
    input.value = ""
  }
  const open = Object.assign(document.createElement("button"), {type: "button", textContent: "Load data"})
  open.title = "A record of telemetry in place of the simulation, or a vibration spectrum: .npz, .csv, .fits"
  open.onclick = () => input.click()
  const back = Object.assign(document.createElement("button"), {type: "button", textContent: "Back to the simulation"})
  back.onclick = () => model.send_msg({action: "simulate"})
  const loaded = document.createElement("span")
  const said = Object.assign(document.createElement("span"), {className: "said"})
  said.setAttribute("role", "status")
  bar.append(input, open, loaded, back, said)
  el.append(bar)
  const draw = () => {
    loaded.textContent = model.loaded
    back.hidden = !model.loaded
    said.textContent = model.said
  }
  model.on("loaded", draw)
  model.on("said", draw)
  draw()
}
