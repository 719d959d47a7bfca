// A search: its button and progress, the ranking it leaves, what is done with a row.
// Models of held designs stand on top of the ranking, in whatever order it is.

const COLUMNS = [
  ["orders", "[na nb nk]", "Orders: coefficients a, coefficients b and delay of each input"],
  ["yic", "YIC", "Young's criterion: large negative is good"],
  ["bic", "BIC", "Schwarz's criterion: small is good"],
  ["r2_t", "R\u00b2 fit", "R_T squared of the simulated output, on the span for estimation"],
  ["checked", "R\u00b2 valid.", "R_T squared of the simulated output, on the span for validation"],
  ["problem", "Problem", "Why a row is not to be trusted"],
]

const MOST = 3  // drawn at once

const worded = (value, digits) => value === null || value === undefined
  ? "\u2013" : Number(value.toFixed(digits)).toString().replace("-", "\u2212")

export function render({ model, el }) {
  let order = { key: "yic", down: false }
  let sent = 0
  let searched = false
  const statistics = { finished: 0 }  // for tests and measurements
  const tell = (message) => { model.sent = { ...message, number: ++sent } }
  const button = (text, action, main = false) => {
    const made = element("button", { type: "button", class: main ? "act main" : "act" }, text)
    made.addEventListener("click", action)
    return made
  }
  const go = button("Search", () => tell({ act: "search" }), true)
  const stop = button("Cancel", () => tell({ act: "cancel" }))
  const bar = element("progress", { max: 1, value: 0, "aria-label": "Progress of the search" })
  const note = element("span", { class: "note", role: "status" })
  const head = element("tr")
  const kept = element("tbody", { class: "held" })
  const body = element("tbody")
  const table = element("table", {}, element("thead", {}, head), kept, body)
  table.setAttribute("aria-label", "Ranking of models")
  const box = element("div", { class: "rows", tabindex: "0", role: "region", "aria-label": "Ranking of models" }, table)
  const empty = element("p", { class: "quiet" })
  const picked = element("div", { class: "picked" })
  el.append(element("div", { class: "ranking" },
    element("div", { class: "search" }, go, stop, bar, note), empty, box, picked))

  const sorters = COLUMNS.map(([key, text, title]) => {
    const cell = element("th", { scope: "col" })
    const sorter = element("button", { type: "button", class: "sort", title }, text)
    sorter.addEventListener("click", () => {
      order = { key, down: order.key === key && !order.down }
      fill()
    })
    cell.append(sorter)
    head.append(cell)
    return [key, cell]
  })

  const before = (a, b) => {
    const [x, y] = [a[order.key], b[order.key]]
    if (Boolean(a.problem) !== Boolean(b.problem) && order.key !== "problem") return a.problem ? 1 : -1
    if (x === null || y === null) return (x === null) - (y === null)
    const sign = order.down ? -1 : 1
    return sign * (typeof x === "string" ? x.localeCompare(y) : x - y)
  }

  const line = (row, tick, name) => {
    const place = model.chosen.indexOf(row.id)
    tick.checked = place >= 0
    tick.disabled = !row.usable || (place < 0 && model.chosen.length >= MOST)
    const mark = element("span", { class: place >= 0 ? `swatch style${place}` : "swatch" })
    const made = element("tr", {},
      element("th", { scope: "row" }, element("label", { class: "check" }, tick, mark, name)),
      element("td", {}, worded(row.yic, 2)), element("td", {}, worded(row.bic, 1)),
      element("td", {}, worded(row.r2_t, 4)), element("td", {}, worded(row.checked, 4)),
      element("td", { class: "problem", title: row.problem }, row.problem))
    if (row.problem) made.classList.add("bad")
    return made
  }
  const found = (row) => {
    const tick = element("input", { type: "checkbox", "data-id": row.id })
    tick.addEventListener("change", () => {
      const others = model.chosen.filter((id) => id !== row.id)
      tell({ act: "choose", chosen: tick.checked ? [...others, row.id] : others })
    })
    return line(row, tick, row.orders)
  }
  const held = (row) => {
    const tick = element("input", { type: "checkbox", "data-id": row.id })
    tick.addEventListener("change", () => {
      const value = [...kept.querySelectorAll("input:checked")].map((box) => box.dataset.id)
      window.dispatchEvent(new CustomEvent("nmss-choose", { detail: { name: "beside", value } }))
    })
    return line(row, tick, element("span", { title: row.words }, row.orders))
  }

  const fill = () => {
    const root = el.getRootNode()
    const focused = root.activeElement?.dataset?.id
    for (const [key, cell] of sorters) {
      cell.ariaSort = key === order.key ? (order.down ? "descending" : "ascending") : "none"
    }
    const chosen = model.chosen
    kept.replaceChildren(...model.held.map(held))
    body.replaceChildren(...[...model.rows].sort(before).map(found))
    if (focused !== undefined) table.querySelector(`[data-id="${focused}"]`)?.focus()
    box.hidden = model.rows.length + model.held.length === 0
    picked.replaceChildren(...chosen.map((id, place) => {
      const mark = element("span", { class: `swatch style${place}` })
      const design = model.held.find((one) => one.id === id)
      if (design) return element("div", {}, mark, element("b", {}, design.orders), design.words)
      const row = model.rows.find((one) => one.id === id)
      return element("div", {}, mark, element("b", {}, row?.orders ?? ""),
        button("Control it: Receding horizon", () => tell({ act: "control", id })),
        button("Govern it: Reference governor", () => tell({ act: "govern", id })),
        button("Save as JSON", () => tell({ act: "save", id })))
    }))
  }

  const progress = () => {
    const { running, done, total, note: text, hint } = model.progress
    if (searched && !running) statistics.finished += 1
    searched = running
    go.textContent = `Search ${total} structure${total === 1 ? "" : "s"}`
    go.disabled = running
    stop.disabled = !running
    stop.hidden = bar.hidden = !running
    bar.max = total
    bar.value = done
    note.textContent = text
    empty.textContent = hint
    empty.hidden = !hint
  }

  model.on("rows", fill)
  model.on("held", fill)
  model.on("chosen", fill)
  model.on("progress", progress)
  handOver(model)
  fill()
  progress()
  followTheme(model, () => model.figures, () => {
    window.nmssIdentify = Object.assign(statistics, {
      rows: () => model.rows.length, running: () => model.progress.running,
    })
  })
}
