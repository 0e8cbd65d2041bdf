// What has the focus, in whatever shadow.
function focused() {
  let it = document.activeElement
  while (it?.shadowRoot?.activeElement) it = it.shadowRoot.activeElement
  return it
}
