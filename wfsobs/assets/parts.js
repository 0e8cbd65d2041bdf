// Files up in parts, and down.

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

function save(name, kind, content) {
  const url = URL.createObjectURL(new Blob([Uint8Array.from(atob(content), (c) => c.charCodeAt(0))], {type: kind}))
  Object.assign(document.createElement("a"), {href: url, download: name}).click()
  setTimeout(() => URL.revokeObjectURL(url), 60_000)
}
