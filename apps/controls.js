// A form made from a description: sliders, selections, and a reset.
// Values go to the server one at a time: the next leaves when the last is answered, or
// is told to take a while; so the latest value wins and nothing queues.

const shown = (value) => {
  if (!Number.isFinite(value)) return String(value)
  const text = Number(value.toPrecision(4)).toString()
  return text.replace("-", "\u2212")
}

const same = (a, b) => JSON.stringify(a) === JSON.stringify(b)

export function render({ model, el }) {
  let values = {}
  let waiting = null   // number of the message that is not answered yet
  let changed = false  // whether values changed since it was sent
  let touched = {}     // and which
  let items = {}       // description of each control, as text
  const typing = {}    // text of number fields that is not entered yet
  let building = false
  let sent = 0
  let address = 0
  let alone = false    // whether it must be answered before the next: it brings others
  let painted = () => {}
  let busy = 0
  const open = {}
  const update = {}    // name -> function that shows a value
  const form = element("form", { class: "choices", "aria-label": "Choices" })
  form.addEventListener("submit", (event) => event.preventDefault())
  el.append(form)

  const latency = []   // of the latest answers: milliseconds from choice to picture
  const idle = () => waiting === null && !changed
  window.nmssForm = { latency, idle }  // for tests and measurements

  // Whoever hears nothing for so long, no answer and not how far it is, asks once more
  const PATIENCE = 10000
  let silence = 0
  const listen = () => {
    clearTimeout(silence)
    silence = setTimeout(() => {
      if (waiting === null) return
      waiting = ++sent
      model.sent = { ...model.sent, message: waiting }
      listen()
    }, PATIENCE)
  }

  const send = () => {
    if (waiting !== null && (alone || model.busy.message !== waiting)) { changed = true; return }
    changed = false
    alone = ["reset", "whole", "case"].some((name) => name in touched) || "whole" in values
    touched = {}
    busy = setTimeout(() => { document.documentElement.dataset.busy = "" }, 300)
    const left = performance.now()
    painted = () => {
      latency.push(performance.now() - left)
      if (latency.length > 500) latency.shift()
    }
    waiting = ++sent
    const { A, B, ...own } = values  // what is held is the bar's to change
    model.sent = { ...own, message: waiting }
    listen()
    delete values.reset
    delete values.whole
  }

  // What was chosen before: whole sets of values, the latest last. A hand that moves one
  // control changes them once. They outlast the page as long as its tab.
  const kept = `nmss-history-${location.pathname}`
  let past = [], future = []
  try { [past, future] = JSON.parse(sessionStorage.getItem(kept)) ?? [[], []] } catch { /* none */ }
  let last = { name: "", at: 0 }
  const tellHistory = () => {
    const detail = { undo: past.length, redo: future.length }
    window.dispatchEvent(new CustomEvent("nmss-history", { detail }))
    try { sessionStorage.setItem(kept, JSON.stringify([past, future])) } catch { /* full */ }
  }
  const remember = (name) => {
    const now = performance.now()
    const on = last.name === name && now - last.at < 1000
    last = { name, at: now }
    if (on) return
    past = [...past.slice(-49), { ...values }]
    future = []
    tellHistory()
  }
  const recall = (from, to) => {
    const before = from.pop()
    if (!before) return
    to.push({ ...values })
    last = { name: "", at: 0 }
    values = { ...before, A: values.A, B: values.B, whole: true }  // what is held stays
    for (const [name, show] of Object.entries(update)) show(values[name])
    needed()
    send()
    tellHistory()
  }
  const undo = () => recall(past, future)
  const redo = () => recall(future, past)
  const keys = (event) => {
    if (!(event.ctrlKey || event.metaKey) || event.altKey) return
    const key = event.key.toLowerCase()
    // a text that is being typed has an undo of its own
    if (/^(text|number)$/.test(event.composedPath()[0].type ?? "")) return
    if (key === "z" && !event.shiftKey) undo()
    else if (key === "y" || key === "z") redo()
    else return
    event.preventDefault()
  }
  const listened = [["keydown", keys], ["nmss-undo", undo], ["nmss-redo", redo], ["nmss-bar", tellHistory]]
  for (const [name, heard] of listened) window.addEventListener(name, heard)

  const choose = (name, value) => {
    remember(name)
    values[name] = value
    touched[name] = value
    if (update[name]) update[name](value)
    needed()
    send()
    clearTimeout(address)
    address = setTimeout(writeAddress, 250)
  }

  const writeAddress = () => {
    const query = new URLSearchParams()
    const defaults = model.form.defaults
    for (const [name, value] of Object.entries(values)) {
      if (!same(value, defaults[name])) query.set(name, value)
    }
    const text = query.toString()
    history.replaceState(null, "", location.pathname + (text ? "?" + text : ""))
    tellAddress(text)
  }

  // What other pages need to know: also a case that this page opens by itself, unless
  // it is there in place of one which it cannot show
  const came = new URLSearchParams(location.search)
  const tellAddress = (text) => {
    const query = new URLSearchParams(text)
    if (values.case) query.set("case", values.case)
    const aside = came.has("via") && came.has("case") && values.case === instead
    const detail = { query: query.toString(), aside }
    window.dispatchEvent(new CustomEvent("nmss-address", { detail }))
  }

  const slider = (item, id) => {
    const log = item.kind === "log"
    const to = log ? Math.log10 : (x) => x
    const back = log ? (x) => Number((10 ** x).toPrecision(3)) : Number
    const input = element("input", {
      type: "range", id, name: item.name, "aria-describedby": id + "-help",
      min: to(item.low), max: to(item.high),
      step: log ? 0.02 : item.step ?? (item.high - item.low) / 100,
    })
    const output = element("output", { for: id })
    const put = (value) => {
      input.value = to(value)
      output.textContent = shown(value)
      input.setAttribute("aria-valuetext", shown(value))
      const share = (to(value) - to(item.low)) / (to(item.high) - to(item.low))
      input.style.setProperty("--share", `${100 * share}%`)
    }
    input.addEventListener("input", () => choose(item.name, back(Number(input.value))))
    update[item.name] = put
    return [element("label", { for: id }, item.label), output, input]
  }

  const select = (item, id) => {
    const input = element("select", {
      id, name: item.name, "aria-describedby": id + "-help",
    })
    for (const [value, text] of item.options) {
      const option = element("option", { value: JSON.stringify(value) })
      option.textContent = text
      input.append(option)
    }
    update[item.name] = (value) => { input.value = JSON.stringify(value) }
    input.addEventListener("change", () => choose(item.name, JSON.parse(input.value)))
    return [element("label", { for: id }, item.label), input]
  }

  const typed = (item, id) => {
    const input = element("input", {
      type: "number", id, name: item.name, "aria-describedby": id + "-help",
      min: item.low, max: item.high, step: "any",
    })
    // What is being typed stays, whatever arrives meanwhile
    update[item.name] = (value) => {
      if (!(item.name in typing)) input.value = Number(value.toPrecision(8))
    }
    if (item.name in typing) input.value = typing[item.name]
    input.addEventListener("input", () => { typing[item.name] = input.value })
    const enter = () => {
      if (building || !(item.name in typing)) return
      delete typing[item.name]
      if (input.value !== "") choose(item.name, Number(input.value))
      else update[item.name](values[item.name])
    }
    // A field that was made anew while somebody typed tells of no change when left
    input.addEventListener("change", enter)
    input.addEventListener("blur", enter)
    return [element("label", { for: id }, item.label), input]
  }

  const text = (item, id) => {
    const input = element("input", {
      type: "text", id, name: item.name, "aria-describedby": id + "-help",
      maxlength: item.longest, spellcheck: "false", autocomplete: "off",
    })
    update[item.name] = (value) => { if (!(item.name in typing)) input.value = value }
    if (item.name in typing) input.value = typing[item.name]
    input.addEventListener("input", () => { typing[item.name] = input.value })
    const enter = () => {
      if (building || !(item.name in typing)) return
      const value = typing[item.name]
      delete typing[item.name]
      choose(item.name, value)
    }
    input.addEventListener("change", enter)
    input.addEventListener("blur", enter)
    input.addEventListener("keydown", (event) => { if (event.key === "Enter") enter() })
    return [element("label", { for: id }, item.label), input]
  }

  const several = (item, id) => {
    const group = element("fieldset", { "aria-describedby": id + "-help" })
    group.append(element("legend", {}, item.label))
    const boxes = item.options.map(([value, text]) => {
      const box = element("input", { type: "checkbox", name: item.name, value })
      box.addEventListener("change", () => {
        const others = values[item.name].filter((other) => other !== value)
        choose(item.name, box.checked ? [...others, value] : others)
      })
      const mark = element("span", { class: "swatch", "aria-hidden": "true" })
      group.append(element("label", { class: "check" }, box, mark, text))
      return [box, mark]
    })
    update[item.name] = (chosen) => {
      for (const [box, mark] of boxes) {
        const place = chosen.indexOf(box.value)
        box.checked = place >= 0
        box.disabled = place < 0 && chosen.length >= item.most
          || place >= 0 && chosen.length === (item.least ?? 1)
        mark.className = place >= 0 ? `swatch style${place}` : "swatch"
      }
    }
    return [group]
  }

  const build = () => {
    const focused = form.getRootNode().activeElement?.name
    for (const part of form.querySelectorAll("details")) {
      open[part.dataset.title] = part.open
    }
    building = true  // a field that is taken away is left, but not entered
    form.replaceChildren()
    building = false
    for (const name of Object.keys(update)) delete update[name]
    items = {}
    for (const [number, group] of model.form.groups.entries()) {
      const part = element("details", {})
      part.dataset.title = group.title
      part.open = open[group.title] ?? true
      part.append(element("summary", {}, group.title))
      for (const item of group.items) {
        items[item.name] = JSON.stringify(item)
        const id = `choice-${item.name}`
        const make = { one: select, several, number: typed, text }[item.kind] ?? slider
        const kind = {
          one: "one", several: "several", number: "field", text: "text",
        }[item.kind] ?? "slider"
        const help = element("p", { id: id + "-help", class: "help" })
        help.textContent = item.help
        const choice = element("div", { class: `choice ${kind}` }, ...make(item, id), help)
        choice.dataset.name = item.name
        part.append(choice)
      }
      form.append(part)
    }
    const reset = element("button", { type: "button", class: "wide" }, "Reset all choices")
    reset.addEventListener("click", () => choose("reset", true))
    form.append(reset)
    take()
    if (focused) form.querySelector(`[name="${focused}"]`)?.focus()
  }

  const take = () => {
    values = { ...model.state.values }
    for (const [name, show] of Object.entries(update)) show(values[name])
    needed()
  }

  const needed = () => {
    for (const { name, when } of model.form.groups.flatMap((group) => group.items)) {
      const idle = when && ![when[1]].flat().includes(values[when[0]])
      // a form that is described anew is not built yet
      form.querySelector(`[data-name="${name}"]`)?.classList.toggle("idle", Boolean(idle))
    }
  }

  // Other parts of a page choose, too: a sample to look into, rows of a sheet
  const elsewhere = ({ detail: { name, value } }) => { if (name in values) choose(name, value) }
  window.addEventListener("nmss-choose", elsewhere)
  // ... and lead to a group of choices
  const group = ({ detail: { title } }) => {
    const part = form.querySelector(`details[data-title="${title}"]`)
    part.open = true
    part.scrollIntoView({ block: "start" })
    part.querySelector("input, select")?.focus({ preventScroll: true })
  }
  window.addEventListener("nmss-group", group)
  model.on("remove", () => {
    clearTimeout(silence)
    window.removeEventListener("nmss-choose", elsewhere)
    window.removeEventListener("nmss-group", group)
    for (const [name, heard] of listened) window.removeEventListener(name, heard)
  })

  // Values that belong to a form which is still on its way wait for it
  let stale = false, held = false
  model.on("form", () => { stale = true; if (held) answered() })
  model.on("state", () => answered())
  const answered = () => {
    held = "form" in model.state && model.state.form !== model.form.number
    if (held) return
    const answer = model.state.message
    if (waiting !== null && answer < waiting) return
    waiting = null
    clearTimeout(silence)
    long.end()
    clearTimeout(busy)
    delete document.documentElement.dataset.busy
    const done = painted
    requestAnimationFrame(() => setTimeout(done, 0))
    if (stale) { renew(); return }
    if (changed) { send(); return }
    take()
    writeAddress()
  }

  // A new form has values of its own; what was touched while it was on its way stays
  // only where its control is still the same one.
  const renew = () => {
    const before = items, later = Object.entries(touched)
    stale = changed = false
    touched = {}
    build()
    writeAddress()
    for (const [name, value] of later) {
      if (name === "reset" || before[name] === items[name]) choose(name, value)
    }
  }

  const long = longAnswer(el, () => {
    alone = true
    changed = false
    waiting = ++sent
    model.sent = { cancel: true, message: waiting }
    listen()
  })
  model.on("busy", () => {
    if (model.busy.message !== waiting) return
    listen()
    long.show(model.busy.share)
    if (changed) send()
  })

  build()
  tellHistory()
  const instead = values.case !== came.get("case") ? values.case : null
  if (came.has("via")) writeAddress()
  else tellAddress(location.search)
}
