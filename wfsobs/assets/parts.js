// Files up in parts.

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

// The button that chooses a file.
function handleFiles(root, take) {
  root.addEventListener("click", (event) => { if (event.target.matches(".pick")) root.querySelector("[type=file]").click() })
  root.addEventListener("change", ({target}) => {
    if (target.type !== "file" || !target.files[0]) return
    take(target.files[0])
    target.value = ""
  })
}
