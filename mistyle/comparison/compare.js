"use strict";
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const at = (id) => document.getElementById(id);
  const [viewer, stage, sheet, said] = ["viewer", "stage", "sheet", "said"].map(at);
  const body = document.querySelector("#rows tbody");
  const lines = [...body.rows];
  const make = (tag, text, kind) => {
    const element = document.createElement(tag);
    if (text !== undefined) element.textContent = text;
    if (kind) element.className = kind;
    return element;
  };
  const MODES = { slider: "slider", flicker: "flicker", pair: "side by side", difference: "difference", false: "false colour" };
  let row = null, mode = "slider", ev = 0, zoom = 0, split = 0.5, timer = 0, box = null;

  const figure = (v) => v === null ? "–" : typeof v === "string" ? v.replace("inf", "∞") : v === 0 ? "0" :
    Math.abs(v) >= 1e-3 && Math.abs(v) < 1e5 ? Number(v.toPrecision(4)).toString() : v.toExponential(2);

  // A render at another exposure: the stored curve is undone and a power of 1/2.2 applied, all in one SVG filter.
  const expose = () => {
    const wide = row.wide > 0 && ev !== 0;
    const amplitude = wide ? (2 ** ev * row.wide) ** (1 / 2.2) : 2 ** (ev / 2.2);
    for (const f of document.querySelectorAll("#exposure feComponentTransfer > *")) {
      f.setAttribute("amplitude", amplitude);
      f.setAttribute("exponent", wide ? data.wide / 2.2 : 1);
      f.setAttribute("offset", 0);
    }
  };
  const picture = (name, exposed) => {
    const image = make("img");
    image.alt = name;
    image.draggable = false;
    const wide = exposed && row.wide > 0 && ev !== 0 ? "_wide" : "";
    image.src = `${row.folder}/${name}${wide}.webp`;
    if (exposed && ev !== 0 && row.kind === "colour") image.style.filter = "url(#exposure)";
    return image;
  };
  const cut = () => {
    const top = sheet.querySelector(".top"), line = sheet.querySelector(".line");
    if (!top) return;
    top.style.clipPath = `inset(0 ${100 * (1 - split)}% 0 0)`;
    line.style.left = `calc(${100 * split}% - 1px)`;
  };
  const outline = () => {
    sheet.querySelectorAll(".box").forEach((b) => b.remove());
    if (!box || mode === "pair") return;
    const mark = make("div", undefined, "box");
    const [x, y, w, h] = box, [width, height] = row.size;
    Object.assign(mark.style, { left: `${100 * x / width}%`, top: `${100 * y / height}%`,
      width: `${100 * w / width}%`, height: `${100 * h / height}%` });
    sheet.append(mark);
  };
  const layout = () => {
    const [width, height] = row.size, both = mode === "pair" || mode === "false" ? 2 : 1;
    const fit = Math.min(stage.clientWidth / (both * width), stage.clientHeight / height);
    const scale = zoom || fit;
    sheet.style.width = `${both * width * scale}px`;
    sheet.style.height = `${height * scale}px`;
    sheet.classList.toggle("near", scale > 1.5);
  };
  const draw = () => {
    clearInterval(timer);
    sheet.replaceChildren();
    sheet.className = mode === "pair" || mode === "false" ? "pair" : "";
    expose();
    const far = data.stops;
    if (mode === "slider") {
      const top = picture("reference", true);
      top.className = "top";
      sheet.append(picture("test", true), top, make("div", undefined, "line"));
      said.textContent = "reference left of the line, test right of it: move the pointer";
      cut();
    } else if (mode === "flicker") {
      const [first, second] = [picture("reference", true), picture("test", true)];
      sheet.append(first, second);
      let on = false;
      const turn = () => { on = !on; second.style.visibility = on ? "hidden" : "visible"; said.textContent = on ? "reference" : "test"; };
      turn();
      timer = setInterval(turn, 600);
    } else if (mode === "pair") {
      sheet.append(picture("reference", true), picture("test", true));
      said.textContent = "reference left, test right";
    } else if (mode === "difference") {
      sheet.append(picture("difference"));
      said.textContent = `test minus reference: blue ${figure(-row.span)}, white 0, red ${figure(row.span)}` + (row.kind === "colour" ? " of linear luminance" : "");
    } else if (mode === "false") {
      sheet.append(picture("reference_false"), picture("test_false"));
      said.textContent = `luminance of reference (left) and test: dark blue ${far[0]}, dark red +${far[1]} stops about ${data.grey}`;
    } else {
      sheet.append(picture(mode));
      said.textContent = `${mode}: black 0, yellow ${mode === "de2000" ? 20 : 1}`;
    }
    layout();
    outline();
  };
  const modes = () => {
    const names = { ...MODES };
    if (row.kind !== "colour") delete names.false;
    for (const name of row.maps || []) names[name] = `${name} map`;
    if (!(mode in names)) mode = "slider";
    at("modes").replaceChildren(...Object.entries(names).map(([name, text]) => {
      const button = make("button", text);
      button.type = "button";
      button.setAttribute("aria-pressed", String(name === mode));
      button.addEventListener("click", () => { mode = name; modes(); draw(); });
      return button;
    }));
  };
  const look = (x, y) => {
    stage.scrollLeft = x * sheet.clientWidth - stage.clientWidth / 2;
    stage.scrollTop = y * sheet.clientHeight - stage.clientHeight / 2;
  };
  const open = (index) => {
    row = data.rows[index];
    box = null;
    viewer.hidden = false;
    lines.forEach((line) => line.classList.toggle("on", Number(line.dataset.row) === index));
    at("called").textContent = [row.image, row.layer, row.test].filter(Boolean).join(" · ");
    at("histogram").src = `${row.folder}/histogram.svg`;
    at("worst").replaceChildren(...row.worst.map((w) => {
      const item = make("li"), button = make("button", `${w[2]}×${w[3]} at ${w[0]}, ${w[1]}: mean error ${figure(w[4])}`);
      button.type = "button";
      button.addEventListener("click", () => {
        box = w;
        zoom = Math.max(1, Math.min(16, 2 ** Math.floor(Math.log2(stage.clientHeight / (3 * w[3])))));
        at("zoom").value = String(zoom);
        draw();
        look((w[0] + w[2] / 2) / row.size[0], (w[1] + w[3] / 2) / row.size[1]);
      });
      item.append(button);
      return item;
    }));
    at("values").replaceChildren(...Object.entries(row.values).map(([name, value]) => {
      const line = make("tr");
      line.append(make("td", name), make("td", figure(value), "n"));
      return line;
    }));
    modes();
    draw();
  };
  const shown = () => [...body.rows].filter((line) => !line.hidden && line.classList.contains("open"));
  const step = (by) => {
    const all = shown(), now = all.findIndex((line) => line.classList.contains("on"));
    if (all.length) open(Number(all[(now + by + all.length) % all.length].dataset.row));
  };

  body.addEventListener("click", (event) => {
    const line = event.target.closest("tr.open");
    if (line) { open(Number(line.dataset.row)); viewer.scrollIntoView({ block: "start" }); }
  });
  body.addEventListener("keydown", (event) => {
    const line = event.target.closest("tr.open");
    if (line && event.key === "Enter") open(Number(line.dataset.row));
  });
  at("previous").addEventListener("click", () => step(-1));
  at("next").addEventListener("click", () => step(1));
  at("ev").addEventListener("input", (event) => {
    ev = Number(event.target.value);
    at("ev-text").textContent = (ev > 0 ? "+" : "") + ev;
    draw();
  });
  at("zoom").addEventListener("change", (event) => { zoom = Number(event.target.value); layout(); });
  stage.addEventListener("pointermove", (event) => {
    if (mode !== "slider" || !row) return;
    const area = sheet.getBoundingClientRect();
    split = Math.min(1, Math.max(0, (event.clientX - area.left) / area.width));
    cut();
  });
  stage.addEventListener("keydown", (event) => {
    if (event.key !== "ArrowLeft" && event.key !== "ArrowRight") return;
    split = Math.min(1, Math.max(0, split + (event.key === "ArrowLeft" ? -0.02 : 0.02)));
    event.preventDefault();
    cut();
  });
  window.addEventListener("resize", () => { if (row) layout(); });

  const filter = () => {
    const text = at("find").value.toLowerCase(), failed = at("failed").checked;
    let count = 0;
    for (const line of lines) {
      line.hidden = (failed && !line.classList.contains("bad")) || !line.textContent.toLowerCase().includes(text);
      count += line.hidden ? 0 : 1;
    }
    at("count").textContent = `${count} of ${lines.length}`;
  };
  at("find").addEventListener("input", filter);
  at("failed").addEventListener("change", filter);
  filter();

  const key = (line, name) => {
    const r = data.rows[Number(line.dataset.row)];
    if (name === "status") return r.failures.length ? 0 : 1;
    if (name in r && typeof r[name] === "string") return r[name];
    const v = r.values[name];
    return v === undefined || v === null ? NaN : v === "inf" ? Infinity : v;
  };
  for (const head of document.querySelectorAll("#rows th[data-key]")) {
    head.addEventListener("click", () => {
      const name = head.dataset.key, down = head.getAttribute("aria-sort") === "ascending";
      document.querySelectorAll("#rows th").forEach((h) => h.removeAttribute("aria-sort"));
      head.setAttribute("aria-sort", down ? "descending" : "ascending");
      const sorted = [...lines].sort((a, b) => {
        const [x, y] = [key(a, name), key(b, name)];
        if (Number.isNaN(x) || Number.isNaN(y)) return Number.isNaN(x) - Number.isNaN(y);
        return (x < y ? -1 : x > y ? 1 : 0) * (down ? -1 : 1);
      });
      body.append(...sorted);
    });
  }
  // A link can name what to show: #row=3&mode=flip&ev=1.
  const wanted = new URLSearchParams(location.hash.slice(1));
  const first = wanted.has("row") ? Number(wanted.get("row")) : data.rows.findIndex((r) => r.folder);
  if (wanted.has("mode")) mode = wanted.get("mode");
  if (wanted.has("ev")) { ev = Number(wanted.get("ev")) || 0; at("ev").value = ev; at("ev-text").textContent = ev; }
  if (data.rows[first] && data.rows[first].folder) open(first);
})();
