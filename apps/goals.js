// Goals as rows that can be edited, bars that show what is attained, and what is done
// with the design found.  Messages go to the server one at a time: the next leaves when
// the last is answered, and rows also when it is told to take a while; so the latest rows
// win and nothing queues.

const written = (value) => value === null || value === undefined || !Number.isFinite(value)
  ? "\u2013" : Number(value.toPrecision(4)).toString().replace("-", "\u2212")

export function render({ model, el }) {
  let rows = []        // as they are shown
  let shape = ""       // what decides which controls there are
  let waiting = null   // number of the message that is not answered yet
  let changed = false  // whether rows changed since it was sent
  let pressed = null   // and what was pressed
  let sent = 0
  let began = 0
  let parts = []       // of each row: function that shows it
  const statistics = { finished: 0, heard: 0 }  // for tests and measurements
  const idle = () => waiting === null && !changed && pressed === null
  const tell = (message) => {
    waiting = ++sent
    model.sent = { ...message, number: waiting }
  }

  const send = () => {
    if (waiting !== null && model.busy.message !== waiting) { changed = true; return }
    changed = false
    const keys = ["objective", "output", "target", "share", "tau"]
    tell({ act: "goals", rows: rows.map((row) => Object.fromEntries(keys.map((k) => [k, row[k]]))) })
  }
  const press = (message) => {
    if (waiting !== null) pressed = message
    else tell(message)
  }
  const button = (text, act, more = {}) => {
    const made = element("button", { type: "button", class: "act", ...more }, text)
    made.addEventListener("click", () => press(typeof act === "function" ? act() : { act }))
    return made
  }

  const long = longAnswer(el, () => {
    changed = false
    pressed = null
    tell({ act: "stay" })
  })
  model.on("busy", () => {
    if (model.busy.message !== waiting) return
    long.show(model.busy.share)
    if (changed) send()
  })

  // The head: tune, progress, and what came of it
  const go = button("Tune", "tune", { class: "act main" })
  const stop = element("button", { type: "button", class: "act" }, "Cancel")
  stop.addEventListener("click", () => { model.stop += 1 })
  const bar = element("progress", { max: 1, value: 0, "aria-label": "Designs tried" })
  const count = element("span", { class: "count" })
  const factor = element("output", { class: "factor" })
  const verdict = element("span", { class: "note", role: "status" })
  const result = element("span", { class: "attained" }, "Attainment factor ", factor, " ", verdict)
  const head = element("div", { class: "search top" }, go, stop, bar, count, result)

  // The rows
  const list = element("ol", { class: "goals", "aria-label": "Goals" })
  const add = button("Add a goal", "add")
  const fresh = button("Suggest", "suggest", { title: "Goals that suit the design to begin with" })

  // What is done with the design
  const undo = button("Undo tuning", "undo", { title: "Back to the design before the last tuning" })
  const on = button("Continue from here", "continue", { title: "The next tuning starts from the present design" })
  const loop = button("Receding horizon \u2192", "loop", { title: "Open the design on the page Receding horizon" })
  const robust = button("Robustness \u2192", "robust", { title: "Open the design on the page Robustness" })
  const gap = element("span", { class: "gap" })
  const done = element("div", { class: "search under" }, add, fresh, gap, undo, on, loop, robust)

  // Matching a gain
  const gain = element("input", { type: "text", id: "gain", name: "gain", spellcheck: "false", autocomplete: "off", maxlength: "4000", "aria-describedby": "gain-help" })
  const matched = button("Match", () => ({ act: "match", text: gain.value }))
  gain.addEventListener("keydown", (event) => { if (event.key === "Enter") matched.click() })
  const own = button("Gain of the case", "gain")
  const found = element("p", { class: "note", role: "status" })
  const help = element("p", { class: "help", id: "gain-help" })
  const match = element("details", { class: "match" }, element("summary", {}, "Match a PIP gain"),
    element("p", { class: "help" }, "Finds weights whose law without limits is u = \u2212K x, so that an existing loop gets limits and keeps its feel."),
    element("div", { class: "search" }, element("label", { for: "gain" }, "Gain K"), gain, own, matched), help, found)
  el.append(element("div", { class: "tuning" }, head, list, done, match))

  const select = (name, label, options, value, choose) => {
    const made = element("select", { name, "aria-label": label })
    for (const [key, text] of options) {
      const option = element("option", { value: JSON.stringify(key) })
      option.textContent = text
      made.append(option)
    }
    made.value = JSON.stringify(value)
    made.addEventListener("change", () => choose(JSON.parse(made.value)))
    return made
  }

  // A number that is typed; what is being typed stays, whatever arrives meanwhile
  const typed = (name, label, least, choose) => {
    const made = element("input", { type: "number", name, step: "any", "aria-label": label, ...least })
    let typing = false
    const enter = () => {
      if (!typing) return
      typing = false
      if (made.value !== "") choose(Number(made.value))
    }
    made.addEventListener("input", () => { typing = true })
    made.addEventListener("change", enter)
    made.addEventListener("blur", enter)
    return [made, (value) => { if (!typing) made.value = Number(value.toPrecision(5)) }]
  }

  const slider = (name, label, choose) => {
    const made = element("input", { type: "range", name, "aria-label": label, step: "any" })
    made.addEventListener("input", () => choose(Number(made.value)))
    const put = (value, low, high, step, text) => {
      Object.assign(made, { min: low, max: high, step })
      made.value = value
      made.setAttribute("aria-valuetext", text)
      made.style.setProperty("--share", `${Math.min(100 * (value - low) / (high - low), 100)}%`)
    }
    return [made, put]
  }

  const build = () => {
    const root = el.getRootNode()
    const focused = root.activeElement?.name
    const { kinds, outputs } = model.offer
    parts = []
    list.replaceChildren(...rows.map((_, i) => {
      const row = rows[i], at = `goal ${i + 1}`
      const change = (values) => { Object.assign(rows[i], values); show(); send() }
      const kind = select(`objective-${i}`, `Objective of ${at}`,
        kinds.map(([key, text]) => [key, text]), row.objective,
        (objective) => change({ objective, target: null }))
      const each = kinds.find(([key]) => key === row.objective)[2]
      const output = select(`output-${i}`, `Output of ${at}`, outputs.map((name, k) => [k, name]),
        row.output, (value) => change({ output: value, target: null }))
      output.hidden = !each || outputs.length === 1
      const [tau, putTau] = typed(`tau-${i}`, `Time constant of ${at}`, { min: 0 }, (value) => change({ tau: value, target: null }))
      const constant = element("label", { class: "tau" }, "\u03c4 ", tau, ` ${model.offer.time}`)
      constant.hidden = row.objective !== "distance"
      const [target, putTarget] = typed(`target-${i}`, `Target of ${at}`, {}, (value) => change({ target: value }))
      const unit = element("span", { class: "unit" })
      const [slide, putSlide] = slider(`slide-${i}`, `Target of ${at}`, (value) => change({ target: Number(value.toPrecision(3)) }))
      const [share, putShare] = slider(`share-${i}`, `Importance of ${at}`, (value) => change({ share: value }))
      const worth = element("span", { class: "worth" })
      const fill = element("div", { class: "fill" }), tick = element("div", { class: "before" })
      const aim = element("div", { class: "aim" }), beyond = element("div", { class: "beyond" }, "\u25b8")
      const track = element("div", { class: "track", role: "img" }, fill, tick, aim, beyond)
      const words = element("span", { class: "words" })
      const away = element("button", { type: "button", class: "away", name: `away-${i}`, "aria-label": `Remove ${at}`, title: "Remove this goal" }, "\u00d7")
      away.disabled = rows.length === 1
      away.addEventListener("click", () => { rows.splice(i, 1); layout(); send() })
      parts.push(() => {
        const row = rows[i]
        if (row.target !== null) putTarget(row.target)
        unit.textContent = row.unit === "-" ? "" : row.unit
        const high = Math.max(row.high, row.target ?? 0), low = Math.min(0, row.target ?? 0)
        putSlide(row.target ?? 0, low, high, row.step, `${written(row.target)} ${row.unit}`)
        if (row.objective === "distance") putTau(row.tau)
        const text = row.share === 0 ? "hard" : `${written(row.share)} %`
        putShare(row.share, 0, 200, 5, text)
        worth.textContent = text
        const now = model.progress.values?.[row.key]
        const best = now === undefined ? row.after : now
        const last = best ?? row.before
        const target_ = row.target ?? 0
        const lo = Math.min(0, target_, row.before ?? 0)
        const hi = 1.08 * Math.max(1.25 * target_, row.before ?? 0, 1e-12)
        const place = (value) => Math.min(Math.max(100 * (value - lo) / (hi - lo), 0), 100)
        const has = best !== undefined && best !== null
        fill.style.width = `${place(last ?? lo)}%`
        fill.className = has ? "fill after" : "fill"
        tick.hidden = row.before === null
        tick.style.left = `${place(row.before ?? lo)}%`
        aim.style.left = `${place(target_)}%`
        beyond.hidden = !(last > hi)
        const missed = last === null || last === undefined ? null : last - target_
        const met = missed !== null && missed <= 1e-6 * Math.max(Math.abs(target_), 1e-9) + 1e-12
        const verdict = missed === null ? "cannot be told"
          : met ? "\u2713 met"
          : `\u2717 missed by ${target_ ? written(Number((100 * missed / Math.abs(target_)).toPrecision(3))) + " %" : written(missed)}`
        words.replaceChildren(element("b", {}, `${written(last)}`), has ? ` from ${written(row.before)}; ` : "; ",
          element("span", { class: met ? "met" : "missed" }, verdict))
        track.setAttribute("aria-label", `${row.label}: now ${written(last)}, before ${written(row.before)}, target ${written(target_)} ${row.unit}; ${verdict}`)
      })
      return element("li", {},
        element("div", { class: "what" }, kind, output, constant),
        element("div", { class: "target" }, element("span", { class: "cap", "aria-hidden": "true" }, "at most"), target, unit, slide),
        element("div", { class: "importance" }, element("span", { class: "cap", "aria-hidden": "true" }, "may miss"), share, worth), element("div", { class: "bar" }, track, words), away)
    }))
    if (focused) list.querySelector(`[name="${focused}"]`)?.focus()
  }

  const show = () => { for (const part of parts) part() }

  const layout = () => {
    const now = JSON.stringify([model.offer, rows.map((row) => [row.objective, row.output])])
    if (now !== shape) { shape = now; build() }
    add.disabled = rows.length >= model.offer.most
    show()
  }

  const take = () => {
    if (waiting !== null && model.state.answer < waiting) return
    waiting = null
    long.end()
    if (changed) { send(); return }
    if (pressed !== null) {
      const message = pressed
      pressed = null
      tell(message)
      return
    }
    rows = model.state.rows.map((row) => ({ ...row }))
    layout()
  }

  const progress = () => {
    const now = model.progress
    statistics.finished = now.ended
    if (now.running) statistics.heard += 1
    go.disabled = matched.disabled = now.running
    go.textContent = now.running ? "Tuning" : "Tune"
    stop.hidden = bar.hidden = !now.running
    stop.disabled = now.stopping
    bar.max = now.most
    if (now.matching) bar.removeAttribute("value")
    else bar.value = now.tried
    began = performance.now() - 1000 * now.elapsed
    factor.textContent = written(now.attainment)
    factor.classList.toggle("met", now.attainment !== null && now.attainment <= 1e-6)
    verdict.textContent = now.note
    undo.disabled = !now.undo || now.running
    on.disabled = !now.tuned || now.running
    for (const button of [loop, robust]) button.disabled = !now.tuned
    own.hidden = !now.gain
    help.textContent = now.shape
    found.textContent = now.match
    tell_time()
    show()
  }

  const tell_time = () => {
    const now = model.progress
    const elapsed = now.running ? (performance.now() - began) / 1000 : now.elapsed
    const time = elapsed ? `, ${elapsed.toFixed(1)} s` : ""
    count.textContent = now.matching ? `Matching${time}`
      : now.tried ? `${now.tried} of at most ${now.most} designs${time}`
      : now.running ? `Starting${time}` : `At most ${now.most} designs`
  }
  const clock = setInterval(() => { if (model.progress.running) tell_time() }, 200)
  model.on("remove", () => clearInterval(clock))

  model.on("state", take)
  model.on("offer", () => { shape = "" })
  model.on("progress", progress)
  model.on("typed", () => { gain.value = model.typed.text })
  handOver(model)
  take()
  progress()
  followTheme(model, () => model.figures, () => {
    window.nmssTune = Object.assign(statistics, {
      idle, running: () => model.progress.running, progress: () => model.progress,
    })
  })
}
