// What a page does by itself: it typesets its equations, fits figures to the screen,
// and tells of controls that nothing answers.

const NARROW = matchMedia("(max-width: 600px)")
const TOUCH = matchMedia("(pointer: coarse)")
const UNANSWERED = "Nothing runs behind this page, so that these controls stay as they are. In JupyterLab (make lab) they move."

// An equation too wide for the screen becomes smaller first, then it scrolls.
const SMALLEST = 0.75

const typeset = () => {
  const { tex2svg } = Bokeh.require("models/text/mathjax/index")
  for (const place of document.querySelectorAll(".math")) {
    const source = place.textContent
    const display = place.classList.contains("display")
    const draw = () => {
      const em = parseFloat(getComputedStyle(place).fontSize)
      const containerWidth = place.parentElement.clientWidth
      const drawn = tex2svg(source, { display, em, ex: em / 2, containerWidth })
      drawn.setAttribute("role", "img")
      drawn.setAttribute("aria-label", source)
      place.replaceChildren(drawn)
    }
    draw()
    let size = 1
    while (display && size > SMALLEST && place.scrollWidth > place.clientWidth) {
      size = Math.max(size * Math.min(place.clientWidth / place.scrollWidth, 0.99), SMALLEST)
      place.style.fontSize = `${0.94 * size}em`
      draw()
    }
  }
}

const models = (doc) => [...doc._all_models.values()]

const placeOf = (doc) => document.getElementById(doc.roots()[0].id)?.closest(".drawn")

const isFixed = (model) => [null, "fixed"].includes(model.sizing_mode)

const narrow = (plot, room) => {
  if (isFixed(plot) && (plot.width ?? 600) > room) plot.width = Math.floor(room)
}

// Paper is the page's own, and nothing is wider than the page.  On a phone figures and
// controls stand below each other, and a finger that lands on a figure scrolls the
// page until a tool is chosen.
const fit = (doc) => {
  const room = placeOf(doc)?.clientWidth ?? Infinity
  for (const model of models(doc)) {
    if (model.type === "Figure") {
      if (model.border_fill_color !== null) {
        model.setv({ border_fill_color: null, background_fill_color: null })
      }
      narrow(model, room)
    }
    if (model.type === "GridPlot") {
      const moved = model.children.some(([, row, column], i) => row !== i || column !== 0)
      if (NARROW.matches && moved) {
        model.children = model.children.map(([plot], i) => [plot, i, 0])
      }
      const columns = 1 + Math.max(...model.children.map(([, , column]) => column))
      for (const [plot] of model.children) narrow(plot, room / columns)
    }
    if (model.min_width > room) model.min_width = null
    if (model.type === "Row" && NARROW.matches && !("flex-wrap" in model.styles)) {
      model.styles = { ...model.styles, "flex-wrap": "wrap" }
    }
    if (model.type === "Toolbar" && TOUCH.matches && model.active_drag === "auto") {
      model.setv({ active_drag: null, autohide: false })
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
  const place = placeOf(doc)
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
