// Bring what stands in an element to what is to stand there; what is the same keeps its focus, its popover and a click under way.
function patch(element, wanted) {
  wanted.forEach((to, i) => {
    const at = element.childNodes[i]
    if (!at) element.append(to)
    else if (at.nodeName !== to.nodeName) at.replaceWith(to)
    else if (at.nodeType !== Node.ELEMENT_NODE) { if (at.data !== to.data) at.data = to.data }
    else {
      for (const {name} of [...at.attributes]) if (!to.hasAttribute(name)) at.removeAttribute(name)
      for (const {name, value} of to.attributes) if (at.getAttribute(name) !== value) at.setAttribute(name, value)
      patch(at, [...to.childNodes])
    }
  })
  while (element.childNodes.length > wanted.length) element.lastChild.remove()
}

function patchHtml(element, html) {
  const wanted = document.createElement("div")
  wanted.innerHTML = html
  patch(element, [...wanted.childNodes])
}
