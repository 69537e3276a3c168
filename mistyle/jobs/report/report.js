"use strict";
(() => {
  const all = (query, root = document) => Array.from(root.querySelectorAll(query));
  const one = (query, root = document) => root.querySelector(query);
  const calm = matchMedia("(prefers-reduced-motion: reduce)");

  // The turntable: a slider, dragging, the arrow keys, and turning by itself until someone takes over.
  for (const table of all(".turntable")) {
    const count = Number(table.dataset.frames);
    const rows = all(".frames", table).map((row) => all("img", row));
    const slider = one(".turn", table), angle = one(".angle", table), play = one(".play", table);
    const swap = one(".swap", table), plinth = one(".plinth", table);
    let frame = 0, timer = 0, seen = true;

    const show = (wanted) => {
      frame = ((Math.round(wanted) % count) + count) % count;
      for (const row of rows) row.forEach((image, k) => image.classList.toggle("on", k === frame));
      slider.value = String(frame);
      angle.value = Math.round((360 * frame) / count) + "°";
      slider.setAttribute("aria-valuetext", angle.value);
    };
    const run = (on) => {
      clearInterval(timer);
      timer = on ? setInterval(() => { if (seen && !document.hidden) show(frame + 1); }, Math.max(50, 9000 / count)) : 0;
      play.setAttribute("aria-pressed", String(on));
    };
    slider.addEventListener("input", () => { run(false); show(Number(slider.value)); });
    play.addEventListener("click", () => run(!timer));
    if (swap) swap.addEventListener("click", () => {
      const plain = table.classList.toggle("plain");
      swap.setAttribute("aria-pressed", String(plain));
    });
    let start = null;
    plinth.addEventListener("pointerdown", (event) => {
      if (event.button !== 0) return;
      start = { x: event.clientX, frame };
      plinth.setPointerCapture(event.pointerId);
      plinth.classList.add("turning");
      run(false);
    });
    plinth.addEventListener("pointermove", (event) => {
      if (start) show(start.frame + ((start.x - event.clientX) / plinth.clientWidth) * count * 0.8);
    });
    for (const end of ["pointerup", "pointercancel"]) plinth.addEventListener(end, () => {
      start = null;
      plinth.classList.remove("turning");
    });
    table.addEventListener("keydown", (event) => {
      if (event.key === " " && event.target === slider) { event.preventDefault(); run(!timer); }
    });
    new IntersectionObserver((entries) => { seen = entries[0].isIntersecting; }).observe(table);
    show(0);
    if (count > 1 && !calm.matches && !location.hash.includes("still")) run(true);
  }

  // The asset itself, once it comes near: unpacked here and handed to the viewer as a blob.
  const model = one("section.model"), asset = one("#asset");
  if (model && asset) {
    const stage = one(".stage3d", model), play = one(".play", model), light = one(".exposure input", model);
    const failed = () => { stage.classList.remove("shown"); one(".failed", model).hidden = false; };
    const unpack = async () => {
      const bytes = Uint8Array.from(atob(asset.textContent), (letter) => letter.charCodeAt(0));
      const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
      return new Response(stream).blob();
    };
    const start = async () => {
      const viewer = document.createElement("model-viewer");
      const first = { "camera-controls": "", "touch-action": "pan-y", "interaction-prompt": "none", "camera-orbit": "30deg 75deg auto",
        "shadow-intensity": "0.7", "shadow-softness": "0.9", "min-camera-orbit": "auto auto 5%", alt: one("img", stage).alt, loading: "eager" };
      for (const [name, value] of Object.entries(first)) viewer.setAttribute(name, value);
      viewer.addEventListener("load", () => { stage.classList.add("shown"); one(".controls", model).hidden = false; });
      viewer.addEventListener("error", failed);
      viewer.src = URL.createObjectURL(await unpack());
      stage.append(viewer);
      light.addEventListener("input", () => { viewer.exposure = 2 ** Number(light.value); });
      play.addEventListener("click", () => {
        viewer.autoRotate = !viewer.autoRotate;
        play.setAttribute("aria-pressed", String(viewer.autoRotate));
      });
      one(".home", model).addEventListener("click", () => {
        viewer.cameraOrbit = first["camera-orbit"];
        viewer.cameraTarget = viewer.fieldOfView = "auto";
        viewer.resetTurntableRotation();
        viewer.exposure = 1;
        light.value = "0";
        viewer.jumpCameraToGoal();
      });
    };
    const near = new IntersectionObserver((entries) => {
      if (!entries.some((entry) => entry.isIntersecting)) return;
      near.disconnect();
      // Asked here, for the viewer itself only writes an error to the console.
      if (document.createElement("canvas").getContext("webgl2")) start().catch(failed);
      else failed();
    }, { rootMargin: "400px" });
    near.observe(stage);
  }

  // What is laid over the maps: one picture per texture set and kind, shown over each of its maps.
  for (const group of all(".maps .group")) {
    const buttons = all(".overlays button", group), legend = one(".legend", group);
    const lay = (button) => {
      for (const each of buttons) each.setAttribute("aria-pressed", String(each === button));
      const source = one("img", button);
      legend.value = button.dataset.legend || "";
      for (const opener of all(".shot .open", group)) {
        for (const old of all(".overlay", opener)) old.remove();
        if (!source) continue;
        const over = new Image();
        over.src = source.src;
        over.alt = "";
        over.className = "overlay";
        opener.append(over);
      }
    };
    for (const button of buttons) button.addEventListener("click", () => lay(button));
  }

  // Before and after: the slider lies invisibly over the picture.
  for (const box of all(".compare")) {
    const slider = one("input", box);
    slider.addEventListener("input", () => box.style.setProperty("--at", slider.value + "%"));
  }

  // Light, dark, or what the system says.
  const root = document.documentElement;
  one(".theme").addEventListener("click", () => {
    const dark = root.dataset.theme ? root.dataset.theme === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
    root.dataset.theme = dark ? "light" : "dark";
  });

  // The link of the part in view is marked.
  const links = new Map(all(".bar nav a").map((link) => [link.getAttribute("href").slice(1), link]));
  const watch = new IntersectionObserver((entries) => {
    for (const entry of entries) if (entry.isIntersecting && links.has(entry.target.id)) {
      for (const link of links.values()) link.removeAttribute("aria-current");
      links.get(entry.target.id).setAttribute("aria-current", "true");
    }
  }, { rootMargin: "-30% 0px -60% 0px" });
  for (const section of all("main > section")) watch.observe(section);

  // The viewer: wheel, pinch-free buttons, dragging, keys.
  const viewer = one(".viewer"), canvas = one(".canvas"), what = one(".what");
  const openers = all(".shot .open");
  let at = 0, image = null, zoom = 1, x = 0, y = 0;

  const place = () => {
    for (const layer of canvas.children) {
      layer.style.transform = `translate(${x}px, ${y}px) scale(${zoom})`;
      layer.style.imageRendering = zoom > 2.5 ? "pixelated" : "";
    }
  };
  const fit = () => {
    const w = image.naturalWidth || 1, h = image.naturalHeight || 1;
    for (const layer of canvas.children) layer.style.width = w + "px", layer.style.height = h + "px";
    zoom = Math.min(canvas.clientWidth / w, canvas.clientHeight / h, Math.max(1, 640 / Math.max(w, h)));
    x = (canvas.clientWidth - w * zoom) / 2;
    y = (canvas.clientHeight - h * zoom) / 2;
    place();
  };
  const scale = (factor, cx = canvas.clientWidth / 2, cy = canvas.clientHeight / 2) => {
    const next = Math.min(Math.max(zoom * factor, 0.05), 32);
    x = cx - ((cx - x) * next) / zoom;
    y = cy - ((cy - y) * next) / zoom;
    zoom = next;
    place();
  };
  const open = (index) => {
    at = (index + openers.length) % openers.length;
    const source = one("img", openers[at]);
    const caption = one("figcaption", openers[at].parentElement);
    image = new Image();
    image.alt = source.alt;
    image.draggable = false;
    image.src = source.src;
    const over = one(".overlay", openers[at]);
    canvas.replaceChildren(image, ...(over ? [over.cloneNode()] : []));
    const words = caption ? Array.from(caption.children, (part) => part.textContent) : [source.alt];
    what.textContent = [...words, `${at + 1} / ${openers.length}`].filter(Boolean).join("  ·  ");
    if (!viewer.open) viewer.showModal();
    image.decode().then(fit, fit);
  };
  openers.forEach((button, index) => button.addEventListener("click", () => open(index)));
  one(".previous", viewer).addEventListener("click", () => open(at - 1));
  one(".next", viewer).addEventListener("click", () => open(at + 1));
  one(".in", viewer).addEventListener("click", () => scale(1.5));
  one(".out", viewer).addEventListener("click", () => scale(1 / 1.5));
  one(".fit", viewer).addEventListener("click", () => fit());
  one(".close", viewer).addEventListener("click", () => viewer.close());
  viewer.addEventListener("close", () => openers[at].focus());
  viewer.addEventListener("keydown", (event) => {
    const does = { ArrowLeft: () => open(at - 1), ArrowRight: () => open(at + 1), "+": () => scale(1.5), "=": () => scale(1.5),
      "-": () => scale(1 / 1.5), 0: () => fit() }[event.key];
    if (does) { event.preventDefault(); does(); }
  });
  canvas.addEventListener("wheel", (event) => {
    event.preventDefault();
    const box = canvas.getBoundingClientRect();
    scale(Math.exp(-event.deltaY * 0.0015), event.clientX - box.left, event.clientY - box.top);
  }, { passive: false });
  canvas.addEventListener("dblclick", () => fit());
  let grip = null;
  canvas.addEventListener("pointerdown", (event) => {
    grip = { x: event.clientX - x, y: event.clientY - y };
    canvas.setPointerCapture(event.pointerId);
    canvas.classList.add("turning");
  });
  canvas.addEventListener("pointermove", (event) => {
    if (!grip) return;
    x = event.clientX - grip.x;
    y = event.clientY - grip.y;
    place();
  });
  for (const end of ["pointerup", "pointercancel"]) canvas.addEventListener(end, () => {
    grip = null;
    canvas.classList.remove("turning");
  });
  addEventListener("resize", () => { if (viewer.open) fit(); });

  // On paper nothing stays folded.
  addEventListener("beforeprint", () => { for (const part of all("details")) part.open = true; });
})();
