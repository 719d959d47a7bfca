// Which reference moves which output: small plots in a grid, one row a reference that
// steps, one column an output, several designs in each cell.

const WIDTH = 220, HEIGHT = 110, LEFT = 44, BOTTOM = 20, TOP = 6, RIGHT = 6

const tick = (value) => Number(value.toPrecision(3)).toString().replace("-", "\u2212")

export function render({ model, el }) {
  const box = element("div", { class: "coupling", tabindex: 0, role: "group", "aria-label": "Cross-coupling" })
  el.append(box)

  const line = (t, values, x, y, held) => {
    const points = []
    for (const [i, value] of values.entries()) {
      if (value === null) break
      if (held && i) points.push(`${x(t[i])},${y(values[i - 1])}`)
      points.push(`${x(t[i])},${y(value)}`)
    }
    return points.join(" ")
  }

  const cell = (row, column, grid) => {
    const { t, cells, references, low, high } = grid
    const x = (time) => (LEFT + (WIDTH - LEFT - RIGHT) * (time - t[0]) / (t.at(-1) - t[0])).toFixed(1)
    const [bottom, top] = [low[column], high[column]]
    const y = (value) => (TOP + (HEIGHT - TOP - BOTTOM) * (top - Math.min(Math.max(value, bottom), top)) / (top - bottom)).toFixed(1)
    const drawn = [drawing("line", { class: "axis", x1: LEFT, x2: LEFT, y1: TOP, y2: HEIGHT - BOTTOM }),
      drawing("line", { class: "axis", x1: LEFT, x2: WIDTH - RIGHT, y1: HEIGHT - BOTTOM, y2: HEIGHT - BOTTOM })]
    for (const value of [bottom, top]) {
      drawn.push(drawing("text", { x: LEFT - 5, y: Number(y(value)) + 4, "text-anchor": "end" }, tick(value)))
    }
    drawn.push(drawing("text", { x: LEFT, y: HEIGHT - 5 }, tick(t[0])),
      drawing("text", { x: WIDTH - RIGHT, y: HEIGHT - 5, "text-anchor": "end" }, `${tick(t.at(-1))} ${grid.unit}`))
    drawn.push(drawing("polyline", { class: "reference", points: line(t, references[row][column], x, y, true) }))
    for (const [i, values] of cells[row][column].entries()) {
      drawn.push(drawing("polyline", { class: `line${i}`, points: line(t, values, x, y, false) }))
    }
    const name = `${grid.outputs[column]} when the reference of ${grid.rows[row]} steps`
    return drawing("svg", { viewBox: `0 0 ${WIDTH} ${HEIGHT}`, role: "img", "aria-label": name }, ...drawn)
  }

  const draw = () => {
    const grid = model.grid
    box.hidden = !grid.rows?.length
    const place = box.closest(".coupling-box") ?? el.getRootNode().host?.closest(".coupling-box")
    if (place) place.hidden = box.hidden
    if (box.hidden) { box.replaceChildren(); return }
    box.style.setProperty("--columns", grid.outputs.length)
    const heads = grid.outputs.map((name, k) => element("div", { class: "head" }, `${name} [${grid.units[k]}]`))
    box.replaceChildren(element("div", { class: "head" }, "steps:"), ...heads,
      ...grid.rows.flatMap((name, row) => [
        element("div", { class: "side" }, name),
        ...grid.outputs.map((_, column) => cell(row, column, grid)),
      ]))
  }
  model.on("grid", draw)
  draw()
}
