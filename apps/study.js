// A study: its button and progress, rates with severity, the worst, the one picked.

const RATES = [
  ["count", "Count"], ["share", "Share [95 %]"],
  ["severity", "How badly"], ["median", "Median"], ["worst", "Worst"],
]

const cells = (row, keys) => keys.map((key) => element("td", {}, row[key]))
const swatch = (style) => element("span", { class: `swatch style${style}` })

export function render({ model, el }) {
  let sent = 0
  let ran = false
  const statistics = { finished: 0 }  // for tests and measurements
  const tell = (message) => { model.sent = { ...message, message: ++sent } }
  const button = (text, action, kind = "act") => {
    const made = element("button", { type: "button", class: kind }, text)
    made.addEventListener("click", action)
    return made
  }
  const go = button("Run", () => tell({ act: "run" }), "act main")
  const stop = button("Cancel", () => tell({ act: "cancel" }))
  const bar = element("progress", { max: 1, value: 0, "aria-label": "Progress of the study" })
  const note = element("span", { class: "note", role: "status" })
  const stale = element("p", { class: "stale", role: "status" })
  const picked = element("section", { class: "drawn", "aria-label": "Realisation picked" })
  const rates = element("div", { class: "sheet" })
  const worst = element("div", { class: "worst" })
  el.append(element("div", { class: "ranking study" },
    element("div", { class: "search" }, go, stop, bar, note), stale, picked, rates, worst))

  const progress = () => {
    const { running, done, total, count, note: text, stale: old, studied } = model.progress
    if (ran && !running) statistics.finished += 1
    ran = running
    go.textContent = `Run ${count.toLocaleString("en")} realisation${count === 1 ? "" : "s"}`
    go.disabled = running && !old
    stop.hidden = bar.hidden = !running
    bar.max = total || 1
    bar.value = done
    note.textContent = running && !text
      ? `${done.toLocaleString("en")} of ${total.toLocaleString("en")}` : text
    stale.hidden = !old
    stale.textContent = studied || running
      ? "Choices have changed: what is shown was studied with earlier ones. Press Run."
      : "Nothing studied yet with these choices. Press Run."
  }

  const table = (head, rows, label) => {
    const line = element("tr", {}, ...head.map((text) => element("th", { scope: "col" }, text)))
    const made = element("table", { "aria-label": label },
      element("thead", {}, line), element("tbody", {}, ...rows))
    return element("div", { class: "rows", tabindex: "0", role: "region", "aria-label": label }, made)
  }

  const fillRates = () => {
    const { rows = [], verdict = "" } = model.rates
    if (rows.length === 0) { rates.replaceChildren(); return }
    const keys = RATES.map(([key]) => key)
    const lines = rows.map((row) => element("tr", {},
      element("th", { scope: "row" }, row.event),
      element("td", {}, swatch(row.style), " ", row.design), ...cells(row, keys)))
    rates.replaceChildren(
      element("h2", {}, "Rates, and how badly"),
      element("p", { class: "quiet verdict" }, verdict),
      table(["Event", "Structure", ...RATES.map(([, text]) => text)], lines, "Rates and severity"),
      element("div", { class: "search" },
        button("Save rates as CSV", () => tell({ act: "rates" })),
        button("Save all realisations as CSV", () => tell({ act: "table" }))))
  }

  const fillWorst = () => {
    const focused = el.getRootNode().activeElement?.dataset?.row
    const number = model.picked.number
    worst.replaceChildren(...model.worst.map((part) => {
      const lines = part.rows.map((row) => {
        const choose = button(`No. ${row.number}`, () => tell({ act: "pick", number: row.number }), "row")
        choose.dataset.row = `${part.style}-${row.number}`
        choose.setAttribute("aria-pressed", String(row.number === number))
        return element("tr", {}, element("th", { scope: "row" }, choose),
          element("td", {}, row.value), element("td", {}, row.radius))
      })
      return element("div", {}, element("h2", {}, swatch(part.style), ` Worst of ${part.design}`),
        table(["Realisation", part.measure, "largest pole"], lines, `Worst of ${part.design}`))
    }))
    if (focused) worst.querySelector(`[data-row="${focused}"]`)?.focus()
  }

  const fillPicked = () => {
    const one = model.picked
    picked.hidden = one.number === undefined
    if (picked.hidden) { picked.replaceChildren(); fillWorst(); return }
    const values = one.values.map(([name, value, nominal]) => element("span", {},
      element("b", {}, name), ` ${value} `, element("span", { class: "quiet" }, `(${nominal})`)))
    const loops = one.loops.map((loop) => element("span", {}, swatch(loop.style),
      ` ${loop.design}: ${one.measure} ${loop.value}, largest pole ${loop.radius}`))
    picked.replaceChildren(
      element("h2", {}, `Realisation ${one.number}`),
      element("p", { class: "values" }, ...values,
        element("span", { class: "quiet" }, "in brackets: nominal")),
      element("p", { class: "values" }, ...loops),
      element("div", { class: "search" },
        button("Open on Receding horizon", () => tell({ act: "open" }), "act main"),
        button("Put it away", () => tell({ act: "unpick" })),
        element("span", { class: "quiet" }, one.note)))
    fillWorst()
  }

  model.on("rates", fillRates)
  model.on("worst", fillWorst)
  model.on("picked", fillPicked)
  model.on("progress", progress)
  handOver(model)
  fillRates()
  fillPicked()
  progress()
  followTheme(model, () => model.figures, () => {
    if (!window.nmssStudy) keepRound(model)
    window.nmssStudy = Object.assign(statistics, {
      running: () => model.progress.running,
      shown: () => model.progress.done,
      picked: () => model.picked.number ?? null,
    })
  })
}
