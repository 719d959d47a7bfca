// What components in the browser share: elements, and figures in the page's colours.

const element = (tag, attributes = {}, ...children) => {
  const node = document.createElement(tag)
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value)
  node.append(...children)
  return node
}

// The same in a picture, which is SVG.
const drawing = (tag, attributes = {}, ...children) => {
  const node = document.createElementNS("http://www.w3.org/2000/svg", tag)
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value)
  node.append(...children)
  return node
}

const icon = (path) =>
  drawing("svg", { viewBox: "0 0 24 24", "aria-hidden": "true" }, drawing("path", { d: path }))

const figureViews = () => {
  const found = {}
  const look = (view) => {
    if (view.model?.type === "Figure" && view.model.name) found[view.model.name] = view
    for (const child of view.child_views ?? []) look(child)
  }
  for (const root of Object.values(Bokeh.index.roots ?? Bokeh.index)) look(root)
  return found
}

// Properties of Bokeh's models, set without telling the server.
const quietly = (thing, values) => thing?.setv(values, { sync: false })

const colorsNow = () => {
  const style = getComputedStyle(document.documentElement)
  const read = (name) => style.getPropertyValue(name).trim()
  return {
    paper: read("--paper"), ink: read("--ink"), quiet: read("--quiet"),
    styles: [read("--style0"), read("--style1"), read("--style2")],
  }
}

// A figure that is focused has a name, and a ring like all else.
const present = (view) => {
  const place = view.canvas_view.events_el
  if (place.hasAttribute("role")) return
  const { title } = view.model
  const name = () => place.setAttribute("aria-label", title.text)
  place.setAttribute("role", "img")
  place.style.setProperty("--outline-width", "3px")
  place.style.setProperty("--outline-style", "solid")
  place.style.setProperty("--highlight-color", "var(--focus)")
  title.properties.text.change.connect(name)
  name()
}

const recolour = (view, colors) => {
  const plot = view.model
  present(view)
  const large = window.innerWidth >= 1900  // a projector, or a wall
  const size = large ? "15px" : "12px"
  quietly(plot.title, {
    text_color: colors.ink, text_font_size: large ? "17px" : "13px",
  })
  for (const axis of [...plot.below, ...plot.left]) {
    if (!axis.type.endsWith("Axis")) continue
    quietly(axis, {
      axis_label_text_color: colors.ink, major_label_text_color: colors.ink,
      axis_label_text_font_size: size, major_label_text_font_size: size,
      axis_line_color: colors.quiet, major_tick_line_color: colors.quiet,
    })
  }
  for (const renderer of plot.renderers) {
    const color = { value: colors.styles[(renderer.name ?? "").at(-1)] ?? colors.ink }
    const kind = (renderer.name ?? "").slice(0, -1)
    const values = kind === "band" ? { fill_color: color }
      : kind === "points" ? { fill_color: color, line_color: color }
      : { line_color: color }
    quietly(renderer.glyph, values)
  }
  for (const side of plot.center) {
    if (side.name === "limit") quietly(side, { line_color: colors.quiet })
  }
}

const keepFile = (blob, name) => {
  const link = element("a", { download: name })
  link.href = URL.createObjectURL(blob)
  link.click()
  setTimeout(() => URL.revokeObjectURL(link.href), 1000)
}

// Circles are round: the longer side of the figure of poles shows more of the plane.
const keepRound = (model) => {
  const round = () => {
    const view = figureViews().poles
    const { width, height } = view.frame.bbox
    if (!(width > 0 && height > 0)) return
    const { x_range: x, y_range: y } = view.model
    const [wide, tall] = [Math.max(1, width / height), Math.max(1, height / width)]
    quietly(x, { start: -x.reset_end * wide, end: x.reset_end * wide })
    quietly(y, { start: -x.reset_end * tall, end: x.reset_end * tall })
  }
  const soon = () => setTimeout(round, 50)
  window.addEventListener("resize", soon)
  model.on("remove", () => window.removeEventListener("resize", soon))
  figureViews().poles.model.x_range.properties.reset_end.change.connect(soon)
  soon()
}

// What the server hands over: ``saved`` is a file to keep, ``leads`` an address to open.
const handOver = (model) => {
  if (model.saved) model.on("saved", () => {
    const { name, text, type = "application/json" } = model.saved
    keepFile(new Blob([text], { type }), name)
  })
  if (model.leads) model.on("leads", () => location.assign(model.leads.to))
}

// Figures in the colours of the page, now and whenever they change; ``ready`` is called
// when as many as there should be are there.
const followTheme = (model, count, ready) => {
  const colour = () => {
    const colors = colorsNow()
    const views = Object.values(figureViews())
    if (views.length < count()) { setTimeout(colour, 60); return }
    for (const view of views) recolour(view, colors)
    ready()
  }
  window.addEventListener("nmss-theme", colour)
  model.on("remove", () => window.removeEventListener("nmss-theme", colour))
  colour()
}

// An answer that takes a while: how far it is, on top of a part, and a way to give it up
const longAnswer = (el, cancel) => {
  const bar = element("progress", { max: 1, value: 0, "aria-label": "Progress of the answer" })
  const button = element("button", { type: "button", class: "wide" }, "Cancel")
  const box = element("div", { class: "long", role: "group", "aria-label": "Working" }, bar, button)
  button.addEventListener("click", cancel)
  return {
    show: (share) => {
      bar.value = share
      if (!box.isConnected) el.prepend(box)
    },
    end: () => box.remove(),
  }
}
