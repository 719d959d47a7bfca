// Plays a run that was sent once. Static curves are Bokeh's; this draws, on a canvas
// between Bokeh's curves and its limits, what moves: the curtain over the future, the
// plan of the present sample, and the fan of past plans. It knows nothing of control.

const ICONS = {
  first: "M5 5v14M19 5 9 12l10 7z",
  back: "M8 5v14M18 5l-8 7 8 7z",
  play: "M7 4.5v15l13-7.5z",
  pause: "M8 5v14M16 5v14",
  forward: "M16 5v14M6 5l8 7-8 7z",
  last: "M19 5v14M5 5l10 7-10 7z",
}

export function render({ model, el }) {
  let run = model.run
  const place = model.place   // where its words go, and what its samples are called
  let time = run.start      // in samples, with a fraction while playing
  let playing = false
  let before = 0
  let frame = 0
  let views = {}
  const layers = new Map()
  const statistics = { frames: 0 }

  // The bar of buttons

  const button = (name, label, action) => {
    const made = element("button", { type: "button", "aria-label": label, title: label })
    made.append(icon(ICONS[name]))
    made.addEventListener("click", action)
    return made
  }
  const last = () => run.samples - 1
  const go = (sample) => {
    time = Math.min(Math.max(sample, 0), last())
    request()
  }
  const play = (on) => {
    playing = on
    status.setAttribute("aria-live", on ? "off" : "polite")
    if (on && time >= last()) time = 0
    toggle.replaceChildren(icon(ICONS[on ? "pause" : "play"]))
    const label = (on ? "Pause" : "Play") + hint("space")
    toggle.setAttribute("aria-label", label)
    toggle.title = label
    before = performance.now()
    request()
  }
  const step = (by) => { play(false); go(Math.floor(time + 1e-9) + by) }
  const noun = place.noun.toLowerCase()
  const hint = (key) => place.keys ? ` (${key})` : ""
  const toggle = button("play", "Play" + hint("space"), () => play(!playing))
  toggle.classList.add("main")
  const scrub = element("input", {
    type: "range", min: 0, max: last(), step: 1, "aria-label": place.noun,
    name: noun,
  })
  scrub.addEventListener("input", () => { play(false); go(Number(scrub.value)) })
  const clock = element("output", { class: "clock", "aria-live": "off" })
  const speed = element("select", { "aria-label": "Speed", title: "Steps a second" })
  for (const rate of [1, 2, 5, 10, 20, 50]) {
    const option = element("option", { value: rate }, `${rate} ${place.plural}/s`)
    option.selected = rate === place.rate
    speed.append(option)
  }
  const check = (name, text, on) => {
    const box = element("input", { type: "checkbox", name })
    box.checked = on
    box.addEventListener("change", () => request())
    return [box, element("label", { class: "check" }, box, text)]
  }
  const [loop, loopLabel] = check("loop", "Loop", true)
  const [fan, fanLabel] = check("fan", place.past, false)
  const status = document.getElementById(place.status)
  const looking = []  // a page that can look into a sample gets a button for it
  if (place.keys && document.getElementById("inside")) {
    const look = element("button", { type: "button", class: "look" }, "Look into this sample")
    look.addEventListener("click", () => {
      play(false)
      const detail = { name: "inside", value: Math.floor(time + 1e-9) }
      window.dispatchEvent(new CustomEvent("nmss-choose", { detail }))
    })
    looking.push(look)
  }
  el.append(
    element("div", { class: "playbar", role: "group", "aria-label": place.label },
      element("div", { class: "buttons" },
        button("first", "To the start" + hint("Home"), () => { play(false); go(0) }),
        button("back", `One ${noun} back` + hint("left arrow"), () => step(-1)),
        toggle,
        button("forward", `One ${noun} on` + hint("right arrow"), () => step(1)),
        button("last", "To the end" + hint("End"), () => { play(false); go(last()) })),
      scrub, clock,
      element("div", { class: "options" }, speed, loopLabel, fanLabel, ...looking)))

  const keys = (event) => {
    const at = event.composedPath()[0]
    if (event.altKey || event.ctrlKey || event.metaKey) return
    if (/^(INPUT|SELECT|TEXTAREA|BUTTON|SUMMARY|A)$/.test(at.tagName ?? "")) return
    const action = {
      " ": () => play(!playing), ArrowLeft: () => step(-1), ArrowRight: () => step(1),
      Home: () => { play(false); go(0) }, End: () => { play(false); go(last()) },
    }[event.key]
    if (action) { event.preventDefault(); action() }
  }
  if (place.keys) document.addEventListener("keydown", keys)

  // The picture

  const layerOf = (view) => {
    const primary = view.canvas_view?.primary?.el ?? view.canvas.primary.el
    let canvas = layers.get(view)
    if (!canvas) {
      canvas = element("canvas", { class: "nmss-moving" })
      canvas.style.cssText = "position:absolute;top:0;left:0;pointer-events:none"
      layers.set(view, canvas)
    }
    if (canvas.previousSibling !== primary) primary.after(canvas)
    const width = primary.clientWidth, height = primary.clientHeight
    const ratio = window.devicePixelRatio || 1
    if (canvas.width !== Math.round(width * ratio)
        || canvas.height !== Math.round(height * ratio)) {
      canvas.width = Math.round(width * ratio)
      canvas.height = Math.round(height * ratio)
      canvas.style.width = width + "px"
      canvas.style.height = height + "px"
    }
    const context = canvas.getContext("2d")
    context.setTransform(ratio, 0, 0, ratio, 0, 0)
    context.clearRect(0, 0, width, height)
    return context
  }

  const marker = (context, style, x, y, r) => {
    context.beginPath()
    if (style === 0) context.arc(x, y, r, 0, 7)
    else if (style === 1) context.rect(x - r, y - r, 2 * r, 2 * r)
    else {
      context.moveTo(x, y - 1.2 * r)
      context.lineTo(x + 1.2 * r, y + r)
      context.lineTo(x - 1.2 * r, y + r)
      context.closePath()
    }
    context.fill()
  }

  // Trails set out from their sample, or are versions of one prediction
  const beginning = (chart, curve, k, dt) =>
    chart.origin ?? run.data[k] + curve.ahead * dt

  const trace = (context, chart, curve, k, X, Y, dt) => {
    const data = run.data, t0 = beginning(chart, curve, k, dt)
    const from = curve.start + k * curve.steps
    context.beginPath()
    if (curve.present !== null) context.moveTo(X(data[k]), Y(data[curve.present + k]))
    for (let i = 0; i < curve.steps; i++) {
      const x = X(t0 + i * dt), y = Y(data[from + i])
      if (i === 0 && curve.present === null) context.moveTo(x, y)
      else context.lineTo(x, y)
      if (curve.held) context.lineTo(X(t0 + (i + 1) * dt), y)
    }
    context.stroke()
  }

  const paint = (chart, view, k, colors) => {
    const context = layerOf(view)
    const box = view.frame.bbox
    const { x_range, y_range } = view.model
    const a = box.width / (x_range.end - x_range.start)
    const b = box.height / (y_range.end - y_range.start)
    const X = (t) => box.left + (t - x_range.start) * a
    const Y = (v) => box.bottom - (v - y_range.start) * b
    const still = chart.origin !== null
    const dt = still ? chart.step : run.data[1] - run.data[0]
    const now = run.data[0] + time * dt
    context.save()
    context.beginPath()
    context.rect(box.left, box.top, box.width, box.height)
    context.clip()
    const x = still ? box.left : X(now)
    context.globalAlpha = 0.82
    context.fillStyle = colors.paper
    context.fillRect(x, box.top, box.right - x, box.height)
    context.lineJoin = "round"
    if (fan.checked) {
      context.lineWidth = 1
      context.globalAlpha = 0.16
      for (const curve of chart.trails) {
        context.strokeStyle = colors.styles[curve.style]
        for (let past = 0; past < k; past++) trace(context, chart, curve, past, X, Y, dt)
      }
    }
    context.globalAlpha = 1
    for (const curve of chart.trails) {
      context.strokeStyle = context.fillStyle = colors.styles[curve.style]
      context.lineWidth = 1.4
      trace(context, chart, curve, k, X, Y, dt)
      const t0 = beginning(chart, curve, k, dt), from = curve.start + k * curve.steps
      const radius = Math.min(3.2, Math.max(1.6, a * dt / 4))
      for (let i = 0; i < curve.steps; i++) {
        marker(context, curve.style, X(t0 + i * dt), Y(run.data[from + i]), radius)
      }
    }
    if (!still) {
      context.strokeStyle = colors.ink
      context.lineWidth = 1
      context.globalAlpha = 0.7
      context.beginPath()
      context.moveTo(Math.round(x) + 0.5, box.top)
      context.lineTo(Math.round(x) + 0.5, box.bottom)
      context.stroke()
    }
    context.restore()
  }

  const describe = (k) => {
    const time_ = run.data[k]
    clock.textContent = run.unit === "-" ? `${noun} ${k + 1} of ${run.samples}`
      : `${noun} ${k} \u00b7 ${Number(time_.toPrecision(4))} ${run.unit}`
    scrub.value = k
    scrub.max = last()
    scrub.style.setProperty("--share", `${100 * k / Math.max(last(), 1)}%`)
    scrub.setAttribute("aria-valuetext", clock.textContent)
    run.words.forEach((words, number) => {
      const row = status.children[number]
      const text = words.texts[words.which[k]]
      if (row.lastChild.textContent !== text) row.lastChild.textContent = text
    })
  }

  const words = () => {
    status.replaceChildren(...run.words.map(({ name }, number) => {
      const swatch = element("span", { class: `swatch style${number}` })
      const title = element("b", {})
      title.textContent = name
      return element("p", {}, swatch, title, element("span", {}))
    }))
  }

  let colors = colorsNow()
  let described = -1
  const draw = (moment) => {
    frame = 0
    if (playing) {
      time += Math.max(moment - before, 0) / 1000 * Number(speed.value)
      before = moment
      if (time >= last()) {
        if (loop.checked) time = 0
        else { time = last(); play(false) }
      }
    }
    const k = Math.min(Math.floor(time + 1e-9), last())
    for (const chart of run.charts) {
      const view = views[chart.name]
      if (view?.frame?.bbox?.width > 0) paint(chart, view, k, colors)
    }
    if (k !== described) {
      describe(k)
      described = k
      if (place.keys) window.dispatchEvent(new CustomEvent("nmss-sample", { detail: k }))
    }
    statistics.frames += 1
    statistics.sample = k
    statistics.playing = playing
    statistics.steps = run.charts.flatMap((chart) => chart.trails.map((t) => t.steps))
    if (playing) request()
  }
  const request = () => { if (!frame) frame = requestAnimationFrame(draw) }

  const theme = () => {
    colors = colorsNow()
    for (const view of Object.values(views)) recolour(view, colors)
    request()
  }

  const find = () => {
    views = figureViews()
    if (run.charts.some((chart) => !views[chart.name])) { setTimeout(find, 60); return }
    for (const view of Object.values(views)) {
      new ResizeObserver(() => setTimeout(request, 50)).observe(view.el)
      for (const range of [view.model.x_range, view.model.y_range]) {
        range.change.connect(() => setTimeout(request, 0))
      }
    }
    theme()
    setTimeout(request, 200)
  }

  // A new run: curves, ranges and labels go to Bokeh without telling the server

  // Bokeh's arrays do not know subarray: it would give the whole of them again
  const part = (start, size) =>
    new Float32Array(run.data.buffer, run.data.byteOffset + 4 * start, size)

  const fill = (chart, view) => {
    const plot = view.model
    for (const { name, start, size } of chart.lines) {
      const source = plot.renderers.find((renderer) => renderer.name === name).data_source
      source.data.t = part(start, size)
      source.data.y = part(start + size, size)
      source.change.emit()
    }
    const limits = plot.center.filter((side) => side.name === "limit")
    limits.forEach((side, i) => quietly(side, { location: chart.limits[i] }))
    quietly(plot.y_range, { start: chart.vertical[0], end: chart.vertical[1] })
    quietly(plot.left[0], { axis_label: chart.axis })
    quietly(plot.below[0], { axis_label: `${chart.across} [${chart.unit}]` })
    quietly(plot.title, { text: chart.title })
    const [start, end] = chart.span
    if (plot.x_range.reset_start !== start || plot.x_range.reset_end !== end) {
      quietly(plot.x_range, { start, end, reset_start: start, reset_end: end })
    }
  }

  model.on("run", () => {
    run = model.run
    for (const chart of run.charts) if (views[chart.name]) fill(chart, views[chart.name])
    described = -1
    time = run.fresh ? run.start : Math.min(time, last())
    words()
    request()
  })
  window.addEventListener("nmss-theme", theme)
  window[place.statistics] = statistics  // for tests and measurements
  words()
  find()
  model.on("remove", () => {
    document.removeEventListener("keydown", keys)
    window.removeEventListener("nmss-theme", theme)
    cancelAnimationFrame(frame)
  })
}
