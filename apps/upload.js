// A button that takes a file; what is too large is named and not read.

export function render({ model, el }) {
  const input = element("input", {
    type: "file", id: "upload", name: "upload", accept: ".csv,.txt,text/csv,text/plain",
    "aria-describedby": "upload-help",
  })
  const label = element("label", { for: "upload" }, "Upload a CSV file")
  const help = element("p", { class: "help", id: "upload-help" },
    `Commas between columns, names in row 1, up to ${model.most / 1e6} MB.`)
  el.append(element("div", { class: "choice field upload" }, label, input, help))
  let number = 0
  const send = (file, data) => {
    model.sent = { name: file.name, size: file.size, data, number: ++number }
    input.value = ""
  }
  input.addEventListener("change", () => {
    const file = input.files[0]
    if (!file) return
    if (file.size > model.most) { send(file, ""); return }
    document.documentElement.dataset.busy = ""
    const reader = new FileReader()
    reader.onload = () => send(file, reader.result.split(",")[1] ?? "")
    reader.onerror = () => send(file, "")
    reader.readAsDataURL(file)
  })
  model.on("answered", () => { delete document.documentElement.dataset.busy })
}
