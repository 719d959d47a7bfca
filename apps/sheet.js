// The sheet of scores: one row a structure, sorted by a click on a heading, up to three
// rows ticked for the plots, the best of each column marked.

const MOST = 3

export function render({ model, el }) {
  let order = { key: "", down: false }
  const group = element("tr", { class: "groups" })
  const head = element("tr")
  const body = element("tbody")
  const table = element("table", { "aria-label": "Scores" }, element("thead", {}, group, head), body)
  const told = element("p", { class: "quiet told" })
  const words = element("p", { class: "verdict", role: "status" })
  const missing = element("ul", { class: "missing quiet" })
  el.append(element("div", { class: "ranking scores" },
    element("div", { class: "rows", tabindex: "0", role: "region", "aria-label": "Scores" }, table),
    words, told, missing))

  const choose = (name, on) => {
    const others = model.chosen.filter((one) => one !== name)
    const value = on ? [...others, name] : others
    window.dispatchEvent(new CustomEvent("nmss-choose", { detail: { name: "structures", value } }))
  }

  const sorter = (key, label, title) => {
    const button = element("button", { type: "button", class: "sort", title, "data-focus": key }, label)
    button.addEventListener("click", () => {
      order = { key, down: order.key === key && !order.down }
      fill()
    })
    const cell = element("th", { scope: "col" }, button)
    cell.ariaSort = key === order.key ? (order.down ? "descending" : "ascending") : "none"
    return cell
  }

  const valueOf = (row, columns) => {
    if (order.key === "title") return row.title
    if (order.key === "stable") return row.stable[1]
    return row.cells[columns.findIndex(({ key }) => key === order.key)].value
  }

  const sorted = (rows, columns) => {
    if (!order.key) return rows
    const sign = order.down ? -1 : 1
    return [...rows].sort((a, b) => {
      const [x, y] = [valueOf(a, columns), valueOf(b, columns)]
      if (x === null || y === null) return (x === null) - (y === null)
      return sign * (typeof x === "string" ? x.localeCompare(y) : x - y)
    })
  }

  const cell = ({ text, best }) => best
    ? element("td", { class: "best" }, element("span", { "aria-hidden": "true" }, "\u2605 "),
      element("b", {}, text), element("span", { class: "unseen" }, " best"))
    : element("td", {}, text)

  const line = (row) => {
    const place = model.chosen.indexOf(row.name)
    const tick = element("input", { type: "checkbox", name: row.name, "data-focus": `row ${row.name}` })
    tick.checked = place >= 0
    tick.disabled = place < 0 ? model.chosen.length >= MOST : model.chosen.length === 1
    tick.addEventListener("change", () => choose(row.name, tick.checked))
    const mark = element("span", { class: place >= 0 ? `swatch style${place}` : "swatch" })
    const label = element("label", { class: "check" }, tick, mark,
      element("span", {}, row.title, row.note ? element("small", { class: "quiet" }, row.note) : ""))
    return element("tr", { class: row.stable[1] ? "lost" : "" }, element("th", { scope: "row" }, label),
      element("td", {}, row.stable[0]), ...row.cells.map(cell))
  }

  const fill = () => {
    const { columns, rows, linear } = model.sheet
    const focused = el.getRootNode().activeElement?.dataset?.focus
    group.replaceChildren(element("td"),
      element("th", { scope: "colgroup", colspan: linear + 1 }, "Without limits, linear"),
      element("th", { scope: "colgroup", colspan: columns.length - linear }, "This run, with limits"))
    head.replaceChildren(sorter("title", "Structure", "Ticked rows, up to three, are plotted"),
      sorter("stable", "Stable", "Whether all poles of the loop lie inside the unit circle"),
      ...columns.map(({ key, label, title }) => sorter(key, label, title)))
    head.children[1 + linear + 1].classList.add("first")
    body.replaceChildren(...sorted(rows, columns).map(line))
    for (const one of body.children) one.children[1 + linear + 1].classList.add("first")
    words.textContent = model.sheet.verdict
    told.textContent = model.sheet.told
    missing.replaceChildren(...model.sheet.missing.map(([title, why]) =>
      element("li", {}, element("b", {}, title), ` cannot be built: ${why}`)))
    if (focused) table.querySelector(`[data-focus="${focused}"]`)?.focus()
  }

  model.on("sheet", fill)
  model.on("chosen", fill)
  fill()
  followTheme(model, () => model.figures, () => {
    if (!window.nmssSheet) keepRound(model)
    window.nmssSheet = { chosen: () => model.chosen, rows: () => model.sheet.rows.length }
  })
}
