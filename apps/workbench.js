// A card of the workbench: one step, with its state, words and buttons, or all of them.

const SIGNS = {
  waiting: "\u00b7", ready: "\u25cb", working: "\u2026", done: "\u2713", stale: "\u21bb", failed: "!",
}
const ROWS = [["yic", "YIC", 2], ["r2", "R\u00b2 fit", 3], ["checked", "R\u00b2 valid.", 3]]

const rounded = (value, digits) => value === null
  ? "\u2013" : value.toFixed(digits).replace("-", "\u2212")

const sign = (state) =>
  element("span", { class: `sign ${state}`, "aria-hidden": "true" }, SIGNS[state])

export function render({ model, el }) {
  let sent = 0
  const tell = (message) => { model.sent = { ...message, number: ++sent } }
  const button = (text, message, kind = "act") => {
    const made = element("button", { type: "button", class: kind }, text)
    made.addEventListener("click", () => tell(message))
    return made
  }
  const whole = "steps" in model.card
  const box = element("div", { class: whole ? "conductor" : "stepcard" })
  el.append(box)

  // What all of them say together

  const statistics = { ended: 0 }  // for tests and measurements
  let ran = false
  const go = button("Do all", { act: "do", step: "report" }, "act main")
  const stop = button("Cancel", { act: "cancel" })
  const note = element("span", { class: "note", role: "status" })
  const list = element("ol", { class: "way", "aria-label": "Steps" })
  const verdict = element("div", { class: "verdict", role: "status" })
  const conduct = () => {
    const { steps, running, left, note: text, good, against } = model.card
    if (ran && !running) statistics.ended += 1
    ran = running
    go.disabled = running || left === 0
    stop.hidden = !running
    note.textContent = text
    list.replaceChildren(...steps.map(([step, name, state]) => element("li", {},
      element("a", { href: `#step-${step}`, class: state }, sign(state), name,
        element("span", { class: "unseen" }, `, ${state}`)))))
    const words = good ? "Verified" : "Not verified yet"
    const why = good
      ? "The review finds no fault, no offset remains, and no plant that was drawn is unstable."
      : "Still to be done or mended:"
    verdict.className = good ? "verdict good" : "verdict"
    verdict.replaceChildren(element("b", {}, words), ` ${why}`,
      ...good ? [] : [element("ul", {}, ...against.map((text) => element("li", {}, text)))])
  }

  // One step

  const state = element("span", { class: "state", role: "status" })
  const mark = element("span", { class: "mark" })
  const title = element("h2", {})
  const act = button("", {})
  const turn = element("button", { type: "button", class: "act" }, "Choices")
  turn.addEventListener("click", () => {
    const { number, name } = model.card
    const detail = { title: `${number} ${name}` }
    window.dispatchEvent(new CustomEvent("nmss-group", { detail }))
  })
  const bar = element("progress", { max: 1, value: 0 })
  const cancel = button("Cancel", { act: "cancel" })
  const words = element("p", { class: "words" })
  const problem = element("p", { class: "problem", role: "alert" })
  const more = element("div", { class: "more" })
  const foot = element("div", { class: "foot" })

  const ranking = (rows, chosen) => {
    const lines = rows.map((row) => {
      const tick = element("input", { type: "radio", name: "model", value: row.orders })
      tick.checked = row.orders === chosen
      tick.addEventListener("change", () => window.dispatchEvent(
        new CustomEvent("nmss-choose", { detail: { name: "model", value: row.orders } })))
      return element("tr", {}, element("th", { scope: "row" },
        element("label", { class: "check" }, tick, row.orders)),
      ...ROWS.map(([key, , digits]) => element("td", {}, rounded(row[key], digits))))
    })
    const head = ["[na nb nk]", ...ROWS.map(([, text]) => text)]
      .map((text) => element("th", { scope: "col" }, text))
    return element("table", { "aria-label": "Models to choose from" },
      element("thead", {}, element("tr", {}, ...head)), element("tbody", {}, ...lines))
  }

  const findings = (found) => {
    const bad = found.filter(([verdict]) => verdict === "bad").length
    const names = { good: "good", note: "note", bad: "BAD" }
    const fold = element("details", {}, element("summary", {},
      `Review: ${found.length} findings, ${bad === 0 ? "none" : bad} of them bad`),
    element("ul", {}, ...found.map(([verdict, text]) =>
      element("li", { class: verdict }, element("b", {}, names[verdict]), ` ${text}`))))
    fold.open = bad > 0
    return fold
  }

  let drawn = ""
  const step = () => {
    const { number, step: key, name, state: now, told, counted, problem: wrong, pictured } = model.card
    const [done, total] = counted
    title.textContent = `${number} ${name}`
    mark.replaceChildren(sign(now))
    state.className = `state ${now}`
    state.textContent = now === "working" && total
      ? `working, ${done.toLocaleString("en")} of ${total.toLocaleString("en")}` : told
    act.textContent = { done: "Done", failed: "Try again", stale: "Do again" }[now] ?? "Do this step"
    if (now === "waiting") act.textContent = "Do up to here"
    act.disabled = now === "done" || now === "working"
    act.setAttribute("aria-label", `${act.textContent}: ${name}`)
    act.onclick = () => tell({ act: "do", step: key })
    turn.hidden = !model.card.choices
    turn.setAttribute("aria-label", `Choices: ${name}`)
    bar.hidden = cancel.hidden = now !== "working"
    bar.max = total || 1
    if (total) bar.value = done
    else bar.removeAttribute("value")
    bar.setAttribute("aria-label", `Progress of ${name}`)
    words.textContent = model.card.words
    words.hidden = !model.card.words
    problem.textContent = wrong
    problem.hidden = !wrong
    const section = document.getElementById(`step-${key}`)
    if (section) {
      section.dataset.state = now
      const place = section.querySelector(".step-charts")
      if (place) place.hidden = !pictured
    }
    const parts = model.card
    const fresh = JSON.stringify([parts.rows, parts.chosen, parts.findings, parts.files, parts.to, parts.legend])
    if (fresh === drawn) return  // what somebody has opened or focused stays
    drawn = fresh
    const focused = el.getRootNode().activeElement?.value
    more.replaceChildren()
    if (parts.rows) more.append(ranking(parts.rows, parts.chosen))
    if (parts.findings) more.append(findings(parts.findings))
    if (parts.files) {
      more.append(element("div", { class: "search" },
        button("Save the report (HTML)", { act: "report" }),
        button("Save the design (JSON)", { act: "design" })))
    }
    if (parts.rows && focused) more.querySelector(`input[value="${focused}"]`)?.focus()
    foot.replaceChildren()
    if (parts.to) foot.append(element("a", { href: parts.to }, `Closer look: ${parts.page}`))
    for (const [style, text] of parts.legend ?? []) {
      foot.append(element("span", { class: "key" },
        element("span", { class: `swatch ${style}` }), text))
    }
  }

  if (whole) {
    box.append(element("div", { class: "search" }, go, stop, note), list, verdict)
    model.on("card", conduct)
    conduct()
    followTheme(model, () => model.figures, () => {
      window.nmssWorkbench = Object.assign(statistics, {
        running: () => model.card.running,
        states: () => model.card.steps.map(([, , state]) => state),
        good: () => model.card.good,
      })
    })
  } else {
    box.append(
      element("div", { class: "stephead" }, mark, title, state, bar, cancel, turn, act),
      problem, words, more, foot)
    model.on("card", step)
    handOver(model)
    step()
  }
}
