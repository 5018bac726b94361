(() => {
  "use strict";
  const root = document.documentElement;
  const theme = document.getElementById("theme");
  const isDark = () => root.dataset.theme ? root.dataset.theme === "dark" : matchMedia("(prefers-color-scheme: dark)").matches;
  const nameTheme = () => { theme.textContent = isDark() ? "Light" : "Dark"; };
  nameTheme();

  const source = document.getElementById("replays");
  const groups = source ? JSON.parse(source.textContent) : [];
  const repaint = () => { palette = readPalette(); nameTheme(); draw(); };
  theme.addEventListener("click", () => { root.dataset.theme = isDark() ? "light" : "dark"; repaint(); });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", repaint);

  function readPalette() {
    const style = getComputedStyle(root), found = {};
    for (const name of ["ego", "adversary", "heat", "field", "goal", "camera", "solid", "floor", "ink", "soft", "line", "warn"]) found[name] = style.getPropertyValue("--" + name).trim();
    return found;
  }
  let palette = readPalette(), group = 0, time = 0, playing = false, speed = 4, last = 0;
  const show = { belief: true, field: true, trails: true };
  const calm = matchMedia("(prefers-reduced-motion: reduce)");

  // One choice of planners for every chart and for the replays.
  const hidden = new Set();
  for (const button of document.querySelectorAll("[data-planner]")) button.addEventListener("click", () => {
    const name = button.dataset.planner;
    if (!hidden.delete(name)) hidden.add(name);
    root.dataset.hide = [...hidden].join(" ");
    for (const same of document.querySelectorAll("[data-planner]")) same.setAttribute("aria-pressed", !hidden.has(same.dataset.planner));
    draw();
  });
  const stage = document.getElementById("stage");
  const scrub = document.getElementById("scrub"), clock = document.getElementById("clock"), play = document.getElementById("play");
  let panels = [], fieldFrames = new Map();

  function unpack(text, cells) {
    const raw = atob(text), out = new Uint8Array(cells);
    let at = 0;
    for (let i = 0; i < raw.length; i++) {
      const byte = raw.charCodeAt(i), run = (byte & 15) + 1;
      out.fill(byte >> 4, at, at + run);
      at += run;
    }
    return out;
  }
  const lengths = () => groups[group].episodes.map(e => (e.trace.poses[0].length - 1) / e.trace.hertz);
  const duration = () => Math.max(...lengths());

  function choose(index) {
    group = index;
    const chosen = groups[group];
    document.querySelectorAll("#groups button").forEach((b, i) => { b.setAttribute("aria-selected", i === index); b.tabIndex = i === index ? 0 : -1; });
    document.getElementById("about").textContent = chosen.about;
    document.getElementById("why").textContent = chosen.why;
    stage.replaceChildren();
    fieldFrames = new Map();
    panels = chosen.episodes.map(episode => {
      const figure = document.createElement("figure"), canvas = document.createElement("canvas"), caption = document.createElement("figcaption");
      canvas.setAttribute("role", "img");
      canvas.setAttribute("aria-label", episode.planner + ": " + episode.outcome);
      const name = document.createElement("strong"), state = document.createElement("span");
      name.textContent = episode.planner;
      state.className = "state";
      caption.append(name, state);
      figure.className = "p-" + episode.planner.toLowerCase().replace("-pomcp", "");
      figure.append(canvas, caption);
      stage.append(figure);
      return { episode, canvas, state, frames: new Map() };
    });
    scrub.max = Math.round(duration() * 10);
    seek(Math.min(...lengths()) * 0.7);  // every planner is still under way, with something to see
  }

  function seek(seconds) {
    time = Math.min(Math.max(seconds, 0), duration());
    scrub.value = Math.round(time * 10);
    clock.textContent = time.toFixed(1) + " s";
    scrub.setAttribute("aria-valuetext", time.toFixed(1) + " seconds");
    draw();
  }

  function setPlaying(on) {
    playing = on;
    play.textContent = on ? "Pause" : "Play";
    if (on) {
      if (time >= duration()) seek(0);
      last = performance.now();
      requestAnimationFrame(advance);
    }
  }
  function advance(now) {
    if (!playing) return;
    const passed = (now - last) / 1000 * speed;
    // Whoever asks for less motion sees a picture per half second of the episode, not a glide.
    if (!calm.matches || passed >= .5) { seek(time + passed); last = now; }
    if (time >= duration()) setPlaying(false); else requestAnimationFrame(advance);
  }

  function trace(ctx, region) {
    ctx.beginPath();
    if (region[0] === "disc") ctx.arc(region[1], region[2], region[3], 0, 7);
    else if (region[0] === "box") ctx.rect(region[1], region[2], region[3] - region[1], region[4] - region[2]);
    else region[1].forEach(([x, y], i) => i ? ctx.lineTo(x, y) : ctx.moveTo(x, y));
    ctx.closePath();
  }

  function beliefPicture(panel, index) {
    const t = panel.episode.trace, key = index + isDark();
    if (!panel.frames.has(key)) {
      const rows = t.beliefRows, columns = t.beliefColumns, levels = unpack(t.beliefs[index][1], rows * columns);
      const picture = document.createElement("canvas");
      picture.width = columns; picture.height = rows;
      const ctx = picture.getContext("2d"), image = ctx.createImageData(columns, rows);
      const colour = parseInt(palette.heat.slice(1), 16);
      for (let r = 0; r < rows; r++) for (let c = 0; c < columns; c++) {
        const at = 4 * ((rows - 1 - r) * columns + c);
        image.data[at] = colour >> 16; image.data[at + 1] = colour >> 8 & 255; image.data[at + 2] = colour & 255;
        image.data[at + 3] = levels[r * columns + c] * 14;
      }
      ctx.putImageData(image, 0, 0);
      panel.frames.set(key, picture);
    }
    return panel.frames.get(key);
  }

  // The field of this moment as dots, larger where the adversary is likelier: told from the belief by shape, not hue.
  function fieldPicture(index, width, height) {
    const key = [index, width, height, isDark()].join();
    if (!fieldFrames.has(key)) {
      if (fieldFrames.size > 24) fieldFrames.clear();
      const { rows, columns, frames } = groups[group].field, levels = unpack(frames[index][1], rows * columns);
      const picture = document.createElement("canvas");
      picture.width = width; picture.height = height;
      const ctx = picture.getContext("2d"), across = width / columns, down = height / rows;
      ctx.fillStyle = palette.field;
      for (let r = 0; r < rows; r++) for (let c = 0; c < columns; c++) {
        const level = levels[r * columns + c];
        if (level < 1) continue;
        ctx.beginPath();
        ctx.arc((c + .5) * across, (rows - r - .5) * down, Math.min(across, down) * (.08 + .3 * level / 15), 0, 7);
        ctx.fill();
      }
      fieldFrames.set(key, picture);
    }
    return fieldFrames.get(key);
  }
  const latest = (frames, moment) => {
    let index = 0;
    while (index + 1 < frames.length && frames[index + 1][0] <= moment) index++;
    return index;
  };

  function draw() {
    if (!groups.length) return;
    const map = groups[group].map;
    for (const panel of panels) {
      const { episode, canvas, state } = panel, t = episode.trace;
      const width = canvas.clientWidth || 240, ratio = window.devicePixelRatio || 1, scale = width / map.width;
      const pixelWidth = Math.round(width * ratio), pixelHeight = Math.round(map.height * scale * ratio);
      if (canvas.width !== pixelWidth || canvas.height !== pixelHeight) { canvas.width = pixelWidth; canvas.height = pixelHeight; }
      const ctx = canvas.getContext("2d"), line = 1 / scale;
      const end = t.poses[0].length - 1, exact = Math.min(time * t.hertz, end), step = Math.floor(exact);
      ctx.setTransform(1, 0, 0, 1, 0, 0);
      ctx.fillStyle = palette.floor;
      ctx.fillRect(0, 0, canvas.width, canvas.height);
      ctx.setTransform(scale * ratio, 0, 0, -scale * ratio, 0, canvas.height);
      if (show.belief && t.beliefs.length) {
        const index = latest(t.beliefs, step);
        ctx.save();
        ctx.scale(1, -1);
        ctx.imageSmoothingEnabled = true;
        ctx.drawImage(beliefPicture(panel, index), 0, -map.height, map.width, map.height);
        ctx.restore();
      }
      const field = groups[group].field;
      if (show.field && field) {
        ctx.save();
        ctx.setTransform(1, 0, 0, 1, 0, 0);
        ctx.globalAlpha = .75;
        ctx.drawImage(fieldPicture(latest(field.frames, step), canvas.width, canvas.height), 0, 0);
        ctx.restore();
      }
      ctx.lineWidth = 1.4 * line;
      for (const zone of map.forbidden) {
        trace(ctx, zone);
        ctx.strokeStyle = palette.warn; ctx.setLineDash([4 * line, 4 * line]); ctx.stroke(); ctx.setLineDash([]);
      }
      for (const c of map.checkpoints) {
        ctx.beginPath(); ctx.arc(c.x, c.y, c.camera, 0, 7);
        ctx.globalAlpha = .1; ctx.fillStyle = palette.camera; ctx.fill();
        ctx.globalAlpha = .55; ctx.setLineDash([2 * line, 3 * line]); ctx.strokeStyle = palette.camera; ctx.stroke(); ctx.setLineDash([]); ctx.globalAlpha = 1;
        ctx.beginPath(); ctx.arc(c.x, c.y, c.r, 0, 7); ctx.strokeStyle = palette.soft; ctx.stroke();
        ctx.save(); ctx.scale(1, -1);
        ctx.fillStyle = palette.soft; ctx.font = `600 ${13 * line}px system-ui, sans-serif`; ctx.textAlign = "center"; ctx.textBaseline = "middle";
        ctx.fillText(c.label, c.x, -c.y); ctx.restore();
      }
      for (const goal of map.goals) { trace(ctx, goal); ctx.strokeStyle = palette.goal; ctx.lineWidth = 3 * line; ctx.stroke(); }
      for (const o of map.obstacles) { trace(ctx, o); ctx.fillStyle = palette.solid; ctx.fill(); }
      const fraction = exact - step, next = Math.min(step + 1, end);
      for (const [offset, colour, radius] of [[3, palette.adversary, map.radii[1]], [0, palette.ego, map.radii[0]]]) {
        const xs = t.poses[offset], ys = t.poses[offset + 1], turns = t.poses[offset + 2];
        const x = (xs[step] + (xs[next] - xs[step]) * fraction) / 1000, y = (ys[step] + (ys[next] - ys[step]) * fraction) / 1000;
        if (show.trails) {
          ctx.beginPath();
          for (let i = 0; i <= step; i++) ctx.lineTo(xs[i] / 1000, ys[i] / 1000);
          ctx.lineTo(x, y);
          ctx.strokeStyle = colour; ctx.lineWidth = 2 * line; ctx.globalAlpha = .75; ctx.lineJoin = "round"; ctx.stroke(); ctx.globalAlpha = 1;
        }
        ctx.strokeStyle = colour;
        if (offset === 0) {
          ctx.beginPath(); ctx.arc(x, y, map.meet, 0, 7);
          ctx.setLineDash([3 * line, 3 * line]); ctx.lineWidth = line; ctx.stroke(); ctx.setLineDash([]);
        }
        ctx.beginPath(); ctx.arc(x, y, radius, 0, 7);
        const hidden = offset === 3 && t.seen[step] === "0";
        ctx.fillStyle = hidden ? palette.floor : colour; ctx.fill();
        ctx.lineWidth = 2 * line; ctx.strokeStyle = colour; ctx.stroke();
        ctx.beginPath(); ctx.moveTo(x, y); ctx.lineTo(x + radius * Math.cos(turns[step] / 100), y + radius * Math.sin(turns[step] / 100));
        ctx.strokeStyle = hidden ? colour : palette.floor; ctx.stroke();
      }
      const past = t.events.filter(([seconds]) => seconds <= time + 1e-6);
      let text = t.seen[step] === "1" ? "a camera sees the adversary" : "the adversary is out of sight", kind = "";
      if (past.length) {
        text = past.map(([seconds, what]) => `${what} at ${seconds.toFixed(1)} s`).join(", ");
        kind = past[0][1] === "mission completed" ? " lost" : past.some(([, what]) => what === "intercepted") ? " met" : "";
      }
      if (episode.note && exact >= end) text += ", " + episode.note;
      state.textContent = text;
      state.className = "state" + kind;
    }
  }

  if (!groups.length) return;
  const tabs = document.getElementById("groups");
  groups.forEach((g, i) => {
    const button = document.createElement("button");
    button.textContent = g.title; button.setAttribute("role", "tab");
    button.addEventListener("click", () => { setPlaying(false); choose(i); });
    tabs.append(button);
  });
  tabs.addEventListener("keydown", event => {
    const move = { ArrowRight: 1, ArrowLeft: -1 }[event.key];
    if (!move) return;
    const index = (group + move + groups.length) % groups.length;
    setPlaying(false); choose(index); tabs.children[index].focus(); event.preventDefault(); event.stopPropagation();
  });
  play.addEventListener("click", () => setPlaying(!playing));
  document.getElementById("restart").addEventListener("click", () => seek(0));
  scrub.addEventListener("input", () => { setPlaying(false); seek(scrub.value / 10); });
  const speeds = document.getElementById("speed");
  speeds.addEventListener("change", () => { speed = Number(speeds.value); });
  const faster = by => {
    speeds.selectedIndex = Math.min(Math.max(speeds.selectedIndex + by, 0), speeds.options.length - 1);
    speed = Number(speeds.value);
  };
  const toggle = name => {
    show[name] = !show[name];
    document.getElementById(name).setAttribute("aria-pressed", show[name]);
    draw();
  };
  for (const name of Object.keys(show)) document.getElementById(name).addEventListener("click", () => toggle(name));
  document.getElementById("field").hidden = !groups.some(g => g.field);
  const jump = by => { setPlaying(false); seek(time + by); };
  const keys = {
    " ": () => setPlaying(!playing), ArrowRight: e => jump(e.shiftKey ? 5 : .5), ArrowLeft: e => jump(e.shiftKey ? -5 : -.5),
    Home: () => jump(-duration()), End: () => jump(duration()), "+": () => faster(1), "-": () => faster(-1),
    b: () => toggle("belief"), f: () => toggle("field"), t: () => toggle("trails"),
  };
  document.getElementById("replay-card").addEventListener("keydown", event => {
    if (event.target.closest("select, #groups") || event.ctrlKey || event.metaKey || event.altKey || !(event.key in keys)) return;
    if (event.key === " " && event.target.tagName === "BUTTON") return;  // a button's own key
    keys[event.key](event);
    event.preventDefault();
  });
  window.addEventListener("resize", draw);
  window.addEventListener("beforeprint", draw);
  const at = location.hash.match(/^#replay=(\d+)(?:,([\d.]+))?$/);
  choose(at ? Math.min(Number(at[1]), groups.length - 1) : 0);
  if (at && at[2]) seek(Number(at[2]));
})();
