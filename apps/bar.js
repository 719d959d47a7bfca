// The bar of designs: what is loaded, undo and redo, two designs that are held, files.

// All figures of the page in one picture, where they stand; ``paint`` draws each.
const places = () => {
  const found = Object.values(figureViews()).filter((view) => view.el.offsetWidth > 0)
  const boxes = found.map((view) => view.el.getBoundingClientRect())
  const left = Math.min(...boxes.map((box) => box.left))
  const top = Math.min(...boxes.map((box) => box.top))
  return {
    width: Math.max(...boxes.map((box) => box.right)) - left,
    height: Math.max(...boxes.map((box) => box.bottom)) - top,
    each: found.map((view, i) => [view, boxes[i].left - left, boxes[i].top - top]),
  }
}

const asSVG = () => {
  const { width, height, each } = places()
  const picture = drawing("svg", { width, height })
  picture.setAttribute("xmlns", "http://www.w3.org/2000/svg")
  picture.style.background = colorsNow().paper
  for (const [view, x, y] of each) {
    const part = view.export("svg").ctx.get_svg()
    part.setAttribute("x", x)
    part.setAttribute("y", y)
    picture.append(part)
  }
  return new Blob([new XMLSerializer().serializeToString(picture)], { type: "image/svg+xml" })
}

const asPNG = async () => {
  const { width, height, each } = places(), sharp = 2
  const canvas = element("canvas", { width: sharp * width, height: sharp * height })
  const context = canvas.getContext("2d")
  context.scale(sharp, sharp)
  context.fillStyle = colorsNow().paper
  context.fillRect(0, 0, width, height)
  for (const [view, x, y] of each) {
    const { width: w, height: h } = view.el.getBoundingClientRect()
    context.drawImage(view.export("png").canvas, x, y, w, h)
    const moving = view.shadow_el?.querySelector(".nmss-moving")
      ?? view.canvas_view?.shadow_el?.querySelector(".nmss-moving")
    if (moving) context.drawImage(moving, x, y, w, h)
  }
  return new Promise((made) => canvas.toBlob(made, "image/png"))
}

export function render({ model, el }) {
  let busy = 0, long = 0
  const send = (what) => {
    clearTimeout(busy)
    if (what.act === "open") long = setTimeout(() => { stop.hidden = false }, 500)
    busy = setTimeout(() => { document.documentElement.dataset.busy = "" }, 300)
    model.sent = { ...what, number: (model.sent.number ?? 0) + 1 }
  }
  model.on("answered", () => {
    clearTimeout(busy)
    clearTimeout(long)
    stop.hidden = true
    delete document.documentElement.dataset.busy
  })
  const button = (text, action, attributes = {}) => {
    const made = element("button", { type: "button", ...attributes })
    made.textContent = text
    made.addEventListener("click", action)
    return made
  }
  const pictured = (path, label, action) => {
    const made = button("", action, { "aria-label": label, title: label, class: "icon" })
    made.append(icon(path))
    return made
  }
  // A menu that closes when something is chosen, with Escape, and when it is left
  const menu = (name) => {
    const summary = element("summary", {})
    const items = element("div", { class: "items" })
    const made = element("details", { class: `menu ${name}` }, summary, items)
    made.addEventListener("keydown", (event) => {
      if (event.key !== "Escape" || !made.open) return
      made.open = false
      summary.focus()
    })
    made.addEventListener("focusout", (event) => {
      if (event.relatedTarget && !made.contains(event.relatedTarget)) made.open = false
    })
    items.addEventListener("click", (event) => {
      if (event.target.closest("button, .choose")) made.open = false
    })
    return [made, summary, items]
  }
  const away = (event) => {
    for (const made of bar.querySelectorAll("details[open]")) {
      if (!event.composedPath().includes(made)) made.open = false
    }
  }
  document.addEventListener("pointerdown", away)

  const asks = (name) => () => window.dispatchEvent(new Event(`nmss-${name}`))
  const undo = pictured("M9 7H15a5 5 0 0 1 0 10H8M9 3 5 7l4 4", "Undo (Ctrl+Z)", asks("undo"))
  const redo = pictured("M15 7H9a5 5 0 0 0 0 10h7M15 3l4 4-4 4", "Redo (Ctrl+Shift+Z)", asks("redo"))
  const history = (event) => {
    undo.disabled = !event.detail.undo
    redo.disabled = !event.detail.redo
  }
  undo.disabled = redo.disabled = true
  window.addEventListener("nmss-history", history)

  const loaded = element("p", { class: "loaded" })
  const slots = Object.fromEntries(["A", "B"].map((key) => [key, menu("slot")]))
  const compare = button("A | B", () => send({ act: "compare" }), {
    title: "Show the held designs side by side", class: "compare",
  })
  const [file, fileSummary, fileItems] = menu("file")
  fileSummary.textContent = "File"

  const chosen = element("input", { type: "file", accept: ".json", "aria-label": "Design file" })
  chosen.addEventListener("change", async () => {
    const [given] = chosen.files
    if (!given) return
    const small = given.size <= model.most  // a larger one is not read
    const text = small ? await given.text() : ""
    send({ act: "open", name: given.name, size: given.size, text })
    chosen.value = ""
  })
  const copy = async () => {
    await navigator.clipboard.writeText(location.href)
    note.textContent = "The link is copied."
    setTimeout(() => { note.textContent = "" }, 2500)
  }
  const note = element("span", { class: "said", role: "status" })

  const stop = button("Stop opening", () => { model.stop += 1 })
  stop.hidden = true

  const bar = element("div", { class: "designs" },
    loaded, undo, redo, slots.A[0], slots.B[0], compare, stop, file, note)
  el.append(bar)

  const show = () => {
    const { title, words, shown, held, files } = model.told
    loaded.replaceChildren()
    const name = element("b", {})
    name.textContent = title
    loaded.append(name, words ? ` ${words}` : "")
    loaded.title = `${title} ${words}`
    for (const [key, [made, summary, items]] of Object.entries(slots)) {
      const now = held[key]
      summary.textContent = now ? `${key}: ${now.words}` : `${key}: empty`
      summary.title = now ? [now.words, now.of, now.misfit].filter(Boolean).join("; ") : "Nothing is held"
      made.classList.toggle("full", Boolean(now))
      items.replaceChildren(...shown.filter(([id]) => id !== key).map(([id, label]) =>
        button(`Hold ${label} as ${key}`, () => send({ act: "hold", which: key, name: id }))))
      if (now) {
        if (now.misfit) {
          const why = element("p", {})
          why.textContent = `Not shown here: ${now.misfit}.`
          items.append(why)
        }
        items.append(button(`Let ${key} go`, () => send({ act: "release", which: key })))
      }
      if (!items.children.length) {
        items.append(element("p", {}, "Nothing here can be held."))
      }
    }
    compare.disabled = !Object.values(held).some((now) => !now.misfit)
    const open = element("label", { class: "choose" }, "Open a design file\u2026", chosen)
    fileItems.replaceChildren(open, ...files.map(([act, id, label]) =>
      button(label, () => send({ act, name: id }))))
    fileItems.append(
      button("Figures as SVG", () => keepFile(asSVG(), "figures.svg")),
      button("Figures as PNG", async () => keepFile(await asPNG(), "figures.png")),
      button("Copy the link to this page", copy))
  }
  model.on("told", show)
  handOver(model)
  show()
  window.dispatchEvent(new Event("nmss-bar"))  // whoever knows the history tells it
  model.on("remove", () => {
    document.removeEventListener("pointerdown", away)
    window.removeEventListener("nmss-history", history)
  })
}
