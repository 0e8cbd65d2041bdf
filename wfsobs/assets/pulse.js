// Answers each picture once it has been painted; the next one waits for that. A page that sleeps paints nothing, so that none are
// kept for it, and it is sent the present when it wakes.
export function render({model, el}) {
  el.style.display = "none"
  const answer = () => requestAnimationFrame(() => model.send_msg({painted: model.picture}))
  model.on("picture", answer)
  answer()
}
