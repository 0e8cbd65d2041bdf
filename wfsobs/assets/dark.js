// Dark where the page is.
function paint(it) {
  const [red, green, blue] = getComputedStyle(document.body).backgroundColor.match(/\d+/g).map(Number)
  it.classList.toggle("dark", red + green + blue < 384)
}
