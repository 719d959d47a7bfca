// Plans of a building side by side, one a controller: zones in the colour of their
// deviation from the reference, with dots where they are colder than it, inputs at their
// places, the surroundings outside.
// Data come once with the run; the player says which sample is shown.

const WIDTH = 360, HEIGHT = 209, LEFT = 14, TOP = 74, METRE = 27.6
const BAR = 88, BAR_HEIGHT = 9

// Blue, white, orange: dark words are read on all of them. The dots tell the blue from
// the orange without colour: in grey they are alike. They are white, so that words stay
// readable, and show the more the colder it is.
const COLD = [90, 165, 209], EVEN = [247, 247, 247], WARM = [232, 144, 58]
const ENDS = [-1, -0.5, 0, 0.5, 1]
const colour = (share) => {
  const end = share < 0 ? COLD : WARM
  const part = Math.min(Math.abs(share), 1)
  return `rgb(${EVEN.map((x, i) => Math.round(x + part * (end[i] - x))).join(" ")})`
}

const fixed = (value, digits) => value.toFixed(digits).replace("-", "\u2212")
const signed = (value) => {
  const text = fixed(value, 2)
  return value > 0 && text !== "0.00" ? `+${text}` : text.replace("\u22120.00", "0.00")
}

export function render({ model, el }) {
  const box = element("div", { class: "floor" })
  el.append(box)
  let shows = []   // one function of the sample for each plan

  const words = (node, text) => { if (node.textContent !== text) node.textContent = text }

  const zone = (part, plan, run) => {
    const x = LEFT + part.left * METRE, width = part.length * METRE
    const height = plan.width * METRE, middle = x + width / 2
    const wall = drawing("rect", { class: "zone", x, y: TOP, width, height })
    const name = drawing("text", { class: "name", x: middle, y: TOP + 18 })
    name.textContent = part.name
    const where = drawing("text", { class: "where", x: middle, y: TOP + 32 })
    where.textContent = part.place
    const group = drawing("g", {}, wall, name, where)
    if (part.output === null) {
      wall.setAttribute("fill", `url(#${plan.hatch})`)
      for (const text of [name, where]) text.classList.add("idle")
      const none = drawing("text", { class: "idle", x: middle, y: TOP + 70 })
      none.textContent = "not controlled"
      group.append(none)
      return [group, () => {}]
    }
    const dots = drawing("rect", { class: "cold", x, y: TOP, width, height, fill: `url(#${plan.dots})` })
    wall.after(dots)
    const value = drawing("text", { class: "value", x: middle, y: TOP + 66 })
    const off = drawing("text", { class: "off", x: middle, y: TOP + 92 })
    group.append(value, off)
    return [group, (k) => {
      const at = k * plan.outputs + part.output
      const y = run.y[at], deviation = y - plan.r[at]
      wall.setAttribute("fill", colour(deviation / plan.full))
      const shown = deviation < 0 ? "visible" : "hidden"
      if (dots.getAttribute("visibility") !== shown) dots.setAttribute("visibility", shown)
      words(value, fixed(y, 2))
      words(off, signed(deviation))
    }]
  }

  const actuator = (part, plan, run) => {
    const x = LEFT + part.at * METRE, y = 44, left = x - BAR / 2
    const name = drawing("text", { class: "name", x: left, y: 18 })
    name.textContent = part.name
    const value = drawing("text", { class: "amount", x: left, y: 36 })
    const filled = drawing("rect", { class: `filled style${run.style}`, x: left, y, width: 0, height: BAR_HEIGHT })
    const arrow = drawing("path", { class: "flow", d: `M${x} ${y + BAR_HEIGHT + 2}V${TOP - 2}m-5 -6 5 6 5 -6` })
    const group = drawing("g", {}, name, value, arrow)
    if (part.low === null || part.high === null) return [group, (k) => {
      words(value, `${fixed(run.u[k * plan.inputs + part.input], 2)} ${part.unit}`)
    }]
    group.append(drawing("rect", { class: "reach", x: left, y, width: BAR, height: BAR_HEIGHT }), filled)
    for (const [at, limit, anchor] of [[left - 4, part.low, "end"], [left + BAR + 4, part.high, "start"]]) {
      const text = drawing("text", { class: "limit", x: at, y: y + BAR_HEIGHT - 1, "text-anchor": anchor })
      text.textContent = fixed(limit, 0)
      group.append(text)
    }
    return [group, (k) => {
      const u = run.u[k * plan.inputs + part.input]
      const share = Math.min(Math.max((u - part.low) / (part.high - part.low), 0), 1)
      filled.setAttribute("width", share * BAR)
      group.classList.toggle("full", share < 1e-6 || share > 1 - 1e-6)
      words(value, `${fixed(u, 2)} ${part.unit}`)
    }]
  }

  const figure = (run, plan) => {
    const outside = drawing("text", { class: "outside", x: WIDTH / 2, y: HEIGHT - 7 })
    const hatch = drawing("pattern", { id: plan.hatch, width: 7, height: 7, patternUnits: "userSpaceOnUse", patternTransform: "rotate(45)" },
      drawing("line", { class: "hatch", x1: 0, x2: 0, y1: 0, y2: 7 }))
    const dots = drawing("pattern", { id: plan.dots, width: 9, height: 9, patternUnits: "userSpaceOnUse", patternTransform: "rotate(45)" },
      drawing("circle", { class: "dot", cx: 4.5, cy: 4.5, r: 2.1 }))
    const parts = [
      ...plan.zones.map((part) => zone(part, plan, run)),
      ...plan.actuators.map((part) => actuator(part, plan, run)),
    ]
    const svg = drawing("svg", { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, role: "img", "aria-label": `Floor plan under ${run.name}` },
      drawing("defs", {}, hatch, dots),
      ...parts.map(([group]) => group),
      drawing("rect", { class: "walls", x: LEFT, y: TOP, width: plan.length * METRE, height: plan.width * METRE }),
      outside)
    const title = element("b", {})
    title.textContent = run.name
    const knows = element("span", { class: "quiet" })
    knows.textContent = run.knows
    shows.push((k) => {
      for (const [, show] of parts) show(k)
      words(outside, `${plan.outside}: ${fixed(plan.v[k], 2)} ${plan.unit}`)
    })
    return element("figure", {},
      element("figcaption", {}, element("span", { class: `swatch style${run.style}` }), title, knows), svg)
  }

  const legend = (plan) => {
    const stops = ENDS.map((end) => `${colour(end)} ${50 + 50 * end}%`).join(", ")
    const bar = element("div", { class: "scale" }, element("div", { class: "cold" }))
    bar.style.background = `linear-gradient(to right, ${stops})`
    const marks = ENDS.map((end) => {
      const mark = element("span", {})
      const text = signed(end * plan.full).replace(/\.?0+$/, "") || "0"
      mark.textContent = end === -1 ? `${text} or less` : end === 1 ? `${text} or more` : text
      return mark
    })
    const title = element("span", {})
    title.textContent = `Deviation from the reference [${plan.unit}], colder is dotted`
    const drawn = element("span", { class: "quiet" }, "Schematic; see what this case assumes.")
    return element("div", { class: "legend" }, drawn, title, element("div", { class: "graded" }, bar, element("div", { class: "marks" }, ...marks)))
  }

  let last = 0   // sample shown
  const show = (k) => { last = k; for (const each of shows) each(k) }
  const draw = () => {
    const plan = model.plan
    const place = el.getRootNode().host?.closest(".floorplan")
    if (place) place.hidden = !plan.runs
    shows = []
    if (!plan.runs) { box.replaceChildren(); return }
    box.replaceChildren(
      element("div", { class: "plans" }, ...plan.runs.map((run) => figure(run, { ...plan, hatch: `hatch${run.style}`, dots: `dots${run.style}` }))),
      legend(plan))
    show(Math.min(last, plan.samples - 1))
  }
  const heard = (event) => {
    last = event.detail
    if (shows.length && last < model.plan.samples) show(last)
  }
  window.addEventListener("nmss-sample", heard)
  model.on("plan", draw)
  model.on("remove", () => window.removeEventListener("nmss-sample", heard))
  last = window.nmssPlayer?.sample ?? 0
  draw()
}
