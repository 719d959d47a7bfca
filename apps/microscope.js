// Shows what holds the plan of the player's sample; nothing is asked of the server.

const rounded = (value, sign = false) => {
  if (!Number.isFinite(value)) return "\u2013"
  const text = Number(value.toPrecision(3)).toString().replace("-", "\u2212")
  return sign && value > 0 ? "+" + text : text
}

export function render({ model, el }) {
  let starts = []   // where the limits of each sample begin, run by run
  let sample = window.nmssPlayer?.sample ?? 0

  const count = () => {
    starts = model.seen.runs.map(({ counts }) => {
      let sum = 0
      return counts.map((n) => (sum += n) - n)
    })
  }

  const cells = (run, entry) => {
    const { width, unit: ofMove } = model.seen
    const data = Array.from({ length: width }, (_, i) => run.data[entry * width + i])
    const [row, saving, share, reach, move] = data
    const [limit, step, unit] = run.rows[row]
    const per = unit ? ` per ${unit}` : ""
    const known = Number.isFinite(move)
    const far = Number.isFinite(reach) ? `${rounded(reach)} ${unit}`.trim() : "any"
    return [
      limit, step, `${rounded(saving)}${per}`,
      Number.isFinite(share) ? `${rounded(100 * share)} %` : "\u2013",
      known ? `${rounded(move, true)} ${ofMove}`.trim() : "\u2013", known ? far : "\u2013",
    ]
  }

  const heads = () => [
    ["Limit", "The limit that holds"],
    ["Step", "Step of the horizon at which it holds; 0 is now"],
    ["Price", "Fall of the plan's cost J for one unit more room, at the margin: twice the multiplier"],
    ["Of J", "The same as a share of the plan's cost"],
    [`A unit more moves ${model.seen.input} by`, "Change of the input that is applied now"],
    ["Holds up to", "More room than this, and other limits hold"],
  ]

  const show = () => {
    const { runs, samples } = model.seen
    if (!runs) return
    const k = Math.min(sample, samples - 1)
    const body = element("tbody", {})
    runs.forEach((run, number) => {
      const n = run.counts[k]
      const name = element("th", { scope: "rowgroup", rowspan: Math.max(n, 1) + (run.more[k] > 0) })
      name.append(element("span", { class: `swatch style${number}` }), run.name)
      const rows = Array.from({ length: n }, (_, i) => cells(run, starts[number][k] + i))
      const lines = rows.map((texts) => element("tr", {}, ...texts.map((text) => element("td", {}, text))))
      const note = (text) => element("tr", {}, element("td", { colspan: heads().length, class: "quiet" }, text))
      if (!n) lines.push(note(run.plans ? "no limit holds the plan" : "makes no plan"))
      if (run.more[k]) lines.push(note(`and ${run.more[k]} more, which cost less`))
      lines[0].prepend(name)
      body.append(...lines)
    })
    const head = element("tr", {}, element("th", { scope: "col" }, "Run"),
      ...heads().map(([text, title]) => element("th", { scope: "col", title }, text)))
    table.replaceChildren(element("thead", {}, head), body)
  }

  const table = element("table", { class: "prices" })
  el.append(element("div", { class: "wide-table", tabindex: 0, role: "region", "aria-label": "Limits that hold the plan" }, table))
  const heard = (event) => { sample = event.detail; show() }
  window.addEventListener("nmss-sample", heard)
  model.on("seen", () => { count(); show() })
  model.on("remove", () => window.removeEventListener("nmss-sample", heard))
  count()
  show()
}
