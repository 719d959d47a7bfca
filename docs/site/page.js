// What a page does by itself: it typesets its equations, fits figures to the screen,
// and tells of controls that nothing answers.

const NARROW = matchMedia("(max-width: 600px)")
const UNANSWERED = "Nothing runs behind this page, so that these controls stay as they are. In JupyterLab (make lab) they move."

const typeset = () => {
  const { tex2svg } = Bokeh.require("models/text/mathjax/index")
  for (const place of document.querySelectorAll(".math")) {
    const source = place.textContent
    const display = place.classList.contains("display")
    const em = parseFloat(getComputedStyle(place).fontSize)
    const containerWidth = place.parentElement.clientWidth
    const drawn = tex2svg(source, { display, em, ex: em / 2, containerWidth })
    drawn.setAttribute("role", "img")
    drawn.setAttribute("aria-label", source)
    place.replaceChildren(drawn)
  }
}

const models = (doc) => [...doc._all_models.values()]

// Paper is the page's own, and on a phone figures stand below each other.
const fit = (doc) => {
  for (const model of models(doc)) {
    if (model.type === "Figure" && model.border_fill_color !== null) {
      model.setv({ border_fill_color: null, background_fill_color: null })
    }
    if (model.type === "GridPlot" && NARROW.matches) {
      if (model.children.every(([, row, column], i) => row === i && column === 0)) continue
      model.children = model.children.map(([plot], i) => [plot, i, 0])
    }
  }
}

// Sliders that were asked beforehand have a model that keeps their answers.
const unanswered = (doc) => {
  if (models(doc).some((model) => model.type.endsWith(".State"))) return []
  const Widget = Bokeh.Models.get("Widget")
  return models(doc).filter((model) =>
    model instanceof Widget && "disabled" in model.attributes && !isText(model))
}

const isText = (model) => /Div|HTML|Markup|Paragraph/.test(model.type)

const tell = (place, controls) => {
  for (const control of controls) control.disabled = true
  const note = document.createElement("p")
  note.className = "told"
  note.textContent = UNANSWERED
  place.before(note)
}

const adapt = (doc) => {
  fit(doc)
  doc.on_change(() => fit(doc))
  const place = document.getElementById(doc.roots()[0].id)?.closest(".drawn")
  const controls = unanswered(doc)
  if (place && controls.length) tell(place, controls)
}

// Figures come one by one, and Bokeh does not say when.
const adaptAll = () => {
  const drawn = document.querySelectorAll(".drawn > [id]").length
  const known = new Set()
  const look = setInterval(() => {
    const fresh = Bokeh.documents.filter((doc) => !known.has(doc) && doc.roots().length)
    for (const doc of fresh) known.add(doc) && adapt(doc)
    if (known.size < drawn) return
    clearInterval(look)
    document.documentElement.dataset.fitted = ""
  }, 50)
}

addEventListener("DOMContentLoaded", () => { typeset(); adaptAll() })
