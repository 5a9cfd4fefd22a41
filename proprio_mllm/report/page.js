"use strict";
// Shows the episodes of a report. Data are JSON in script elements; everything reaches the page as text (textContent), never as markup.
(() => {
  const read = (id) => JSON.parse(document.getElementById(id).textContent);
  const at = (id) => document.getElementById(id);
  const episodes = read("listed");
  const names = read("names");
  const ROW = 46; // pixels, as --row in the style
  const SELECTS = ["run", "robot", "category", "family", "outcome", "failure"];
  const words = (text) => String(text).replaceAll("_", " ");
  const fixed = (value, digits) => (value === null ? "" : value.toFixed(digits));

  // Columns of the list: key in the address, heading, value to sort by, text.
  const COLUMNS = [
    { key: "number", title: "#", value: (e) => e.number, text: (e) => String(e.number), figure: true },
    { key: "episode", title: "Episode", value: (e) => (e.instruction || e.task).toLowerCase(), text: null },
    { key: "outcome", title: "Outcome", value: (e) => e.outcome + (e.failure || ""), text: null },
    { key: "goals", title: "Goals", value: (e) => e.goal_conditions_met, text: (e) => `${Math.round(100 * e.goal_conditions_met)} %`, figure: true },
    { key: "steps", title: "Steps", value: (e) => e.steps, text: (e) => String(e.steps), figure: true },
    { key: "time", title: "Time", value: (e) => e.makespan_s, text: (e) => `${fixed(e.makespan_s, 0)} s`, figure: true },
  ];

  episodes.forEach((episode, number) => {
    episode.number = number;
    episode.search = [episode.task, episode.instruction, episode.family, episode.room, episode.codes].join(" ").toLowerCase();
  });

  function make(tag, attributes = {}, ...children) {
    const element = document.createElement(tag);
    for (const [name, value] of Object.entries(attributes)) {
      if (value !== null && value !== undefined && value !== false) element.setAttribute(name, value);
    }
    for (const child of children) if (child !== null && child !== undefined) element.append(child);
    return element;
  }

  // ---- state, kept in the address

  const state = { q: "", run: "", robot: "", category: "", family: "", outcome: "", failure: "", sort: "number", desc: "", episode: "" };

  function fromAddress() {
    const given = new URLSearchParams(location.hash.slice(1));
    for (const key of Object.keys(state)) state[key] = given.get(key) ?? (key === "sort" ? "number" : "");
    if (!COLUMNS.some((column) => column.key === state.sort)) state.sort = "number";
  }

  function toAddress() {
    const kept = Object.entries(state).filter(([key, value]) => value !== "" && !(key === "sort" && value === "number"));
    const text = new URLSearchParams(kept).toString();
    history.replaceState(null, "", `#${text}`);
  }

  // ---- filters

  for (const key of SELECTS) {
    if (key === "run") continue;
    const values = [...new Set(episodes.map((episode) => episode[key]).filter((value) => value))].sort();
    at(key).append(make("option", { value: "" }, "all"), ...values.map((value) => make("option", { value }, words(value))));
  }

  let shown = [];
  function filter() {
    const parts = state.q.toLowerCase().split(/\s+/).filter(Boolean);
    shown = episodes.filter(
      (episode) =>
        SELECTS.every((key) => state[key] === "" || String(episode[key]) === state[key]) &&
        parts.every((part) => episode.search.includes(part)),
    );
    const { value } = COLUMNS.find((column) => column.key === state.sort);
    const sign = state.desc ? -1 : 1;
    shown.sort((a, b) => {
      const [x, y] = [value(a), value(b)];
      return x === y ? a.number - b.number : sign * (x < y ? -1 : 1);
    });
    const good = shown.filter((episode) => episode.outcome === "success").length;
    at("count").textContent = `${shown.length} of ${episodes.length} episodes, ${good} successful`;
  }

  // ---- list: only rows in view are in the page

  const list = at("list");
  const body = at("body");
  let everything = false; // for printing
  let drawn = "";

  for (const column of COLUMNS) {
    const button = make("button", { type: "button" }, column.title);
    button.addEventListener("click", () => {
      state.desc = state.sort === column.key && !state.desc ? "1" : "";
      state.sort = column.key;
      refresh();
    });
    at("columns").append(make("th", { scope: "col", class: `c-${column.key}${column.figure ? " figure" : ""}`, id: `sort-${column.key}` }, button));
  }

  function badge(episode) {
    const kind = episode.outcome === "infrastructure_error" ? "odd" : episode.outcome;
    const text = episode.outcome === "failure" ? words(episode.failure) : episode.outcome !== "success" ? "broke" : episode.in_time ? "success" : "success, late";
    return make("span", { class: `badge ${kind}` }, text);
  }

  function row(episode, index) {
    const selected = String(episode.number) === state.episode;
    const line = make("tr", { id: `row-${episode.number}`, "aria-rowindex": index + 2, "aria-selected": String(selected) });
    for (const column of COLUMNS) {
      const cell = make("td", { class: `c-${column.key}${column.figure ? " figure" : ""}` });
      if (column.key === "episode") {
        const about = [names.length > 1 ? `run ${episode.run + 1}` : null, episode.robot, episode.category, words(episode.family), episode.trial ? `trial ${episode.trial}` : null, episode.task];
        cell.append(make("span", { class: "two" }, episode.instruction || episode.task), make("span", { class: "two" }, about.filter(Boolean).join(" · ")));
        cell.title = episode.instruction;
      } else cell.append(column.key === "outcome" ? badge(episode) : column.text(episode));
      line.append(cell);
    }
    line.addEventListener("click", () => open(episode.number));
    return line;
  }

  function draw(force) {
    const first = everything ? 0 : Math.max(0, Math.floor(list.scrollTop / ROW) - 8);
    const last = everything ? shown.length : Math.min(shown.length, first + Math.ceil(list.clientHeight / ROW) + 18);
    const now = `${first}-${last}`;
    if (!force && now === drawn) return;
    drawn = now;
    const space = (count) => {
      const cell = make("td", { class: "space" });
      cell.style.height = `${count * ROW}px`;
      return make("tr", { role: "presentation" }, cell);
    };
    body.replaceChildren(space(first), ...shown.slice(first, last).map((episode, i) => row(episode, first + i)), space(shown.length - last));
    at("rows").setAttribute("aria-rowcount", shown.length + 1);
    if (at(`row-${state.episode}`)) at("rows").setAttribute("aria-activedescendant", `row-${state.episode}`);
    else at("rows").removeAttribute("aria-activedescendant");
  }

  function position() {
    return shown.findIndex((episode) => String(episode.number) === state.episode);
  }

  function reveal() {
    const index = position();
    if (index < 0) return;
    const head = at("columns").offsetHeight;
    if (index * ROW < list.scrollTop) list.scrollTop = index * ROW;
    else if ((index + 1) * ROW + head > list.scrollTop + list.clientHeight) list.scrollTop = (index + 1) * ROW + head - list.clientHeight;
  }

  // ---- the opened episode

  const costs = (e) => [
    ["steps", e.time_limit === null ? e.steps : `${e.steps - e.struck}, in time ${e.time_limit}`],
    ...(e.struck ? [["spoiled by a contingency, not charged", e.struck]] : []),
    ["goals met", `${Math.round(100 * e.goal_conditions_met)} %`],
    ["makespan", `${fixed(e.makespan_s, 1)} s`],
    ["path", `${fixed(e.path_length_m, 2)} m`],
    ["arms", `${Math.round(100 * e.arm_utilisation)} %`],
    ["calls", e.planner_calls],
    ["tokens", e.planner_tokens],
    ["planner", `${fixed(e.planner_s, 2)} s`],
    ["invalid replies", e.invalid_output],
  ];

  function goals(episode) {
    if (!episode.goals.length) return null;
    const rows = episode.goals.map((goal) => {
      const said =
        goal.held === null ? (episode.outcome === "success" ? "held at the end" : "")
        : goal.since === 0 ? "from the start"
        : goal.since !== null ? `since step ${goal.since}`
        : goal.held.includes(true) ? `lost after step ${goal.held.lastIndexOf(true)}` : "never";
      const track = make("div", { class: "track", "aria-hidden": "true" });
      (goal.held || []).forEach((held, step) => track.append(make("i", { class: held ? "held" : null, title: step ? `step ${step}` : "start" })));
      return make("tr", {}, make("th", { scope: "row" }, make("code", {}, goal.text)), make("td", {}, said), make("td", {}, track));
    });
    return make("section", { "aria-label": "Goals" }, make("h3", {}, "Goals"), make("table", { class: "goals" }, make("tbody", {}, ...rows)));
  }

  function outcome(one) {
    const line = make("li", {});
    const name = one.action || "reply";
    line.append(make("span", { class: one.ok ? "ok" : "wrong" }, one.ok ? "✓ " : "✗ "), make("code", {}, name), one.ok ? " done" : ` ${one.code}: ${one.meaning}`);
    for (const said of one.margins_in_words) line.append(make("span", { class: "sub" }, said));
    if (one.contingency) line.append(make("span", { class: "sub" }, `contingency drawn: ${words(one.contingency)}`));
    return line;
  }

  function picture(episode, index) {
    if (!episode.images.length) return null;
    const alt = index ? `Head camera after step ${index}` : "Head camera at the start";
    return make("img", { src: `data:image/jpeg;base64,${episode.images[episode.shown[index]]}`, alt, decoding: "async" });
  }

  function steps(episode) {
    const items = [];
    if (episode.images.length) {
      items.push(make("li", { class: "step" }, picture(episode, 0), make("div", { class: "said" }, make("h4", {}, "Start"))));
    }
    episode.trace.forEach((step, index) => {
      const deciding = episode.why !== null && episode.why.step === index + 1;
      const said = make("div", { class: "said" }, make("h4", {}, `${index + 1}. `, make("code", {}, step.step || "(empty reply)")));
      said.append(make("ul", { "aria-label": "Feedback" }, ...step.outcomes.map(outcome)));
      const gained = episode.goals.filter((goal) => goal.held !== null && goal.held[index + 1] && !goal.held[index]);
      const lost = episode.goals.filter((goal) => goal.held !== null && !goal.held[index + 1] && goal.held[index]);
      for (const goal of gained) said.append(make("p", { class: "ok" }, "goal reached: ", make("code", {}, goal.text)));
      for (const goal of lost) said.append(make("p", { class: "wrong" }, "goal lost: ", make("code", {}, goal.text)));
      if (step.differs) said.append(make("p", {}, make("span", { class: "badge odd" }, `differs from the ledger: now ${step.codes_now.map((code) => code || "ok").join(", ")}`)));
      said.append(make("p", { class: "quiet" }, `${fixed(step.duration_s, 1)} s`));
      items.push(make("li", { class: deciding ? "step deciding" : "step" }, picture(episode, index + 1), said));
    });
    return make("section", { "aria-label": "Steps" }, make("h3", {}, "Steps"), make("ol", { class: "steps" }, ...items));
  }

  function detail() {
    const place = at("episode");
    const number = /^\d+$/.test(state.episode) ? Number(state.episode) : -1;
    if (number < 0 || number >= episodes.length) {
      place.replaceChildren(make("p", { class: "quiet" }, "Choose an episode: click it, or go through the list with the arrow keys."));
      return;
    }
    const episode = read(`episode-${number}`);
    const index = position();
    const move = (title, label, by) => {
      const button = make("button", { type: "button", "aria-label": label, title: label, disabled: shown[index + by] && index >= 0 ? null : "" }, title);
      button.addEventListener("click", () => open(shown[index + by].number));
      return button;
    };
    const head = make("div", { class: "head" },
      make("div", {}, badge(episodes[number]), make("span", { class: "quiet" }, `episode ${number} · ${names[episodes[number].run]}`)),
      make("div", { class: "moves" }, move("↑", "Previous episode", -1), " ", move("↓", "Next episode", 1)));
    const about = [episode.task, `${episode.category}${episode.family ? ` / ${words(episode.family)}` : ""}`, words(episode.room), `trial ${episode.trial}`, `seed ${episode.seed}`];
    const list_of_costs = make("dl", { class: "costs" }, ...costs(episode).map(([name, value]) => make("div", {}, make("dt", {}, `${name} `), make("dd", {}, String(value)))));
    place.replaceChildren(head, make("h2", {}, episode.instruction || episode.task), make("p", { class: "quiet" }, about.filter(Boolean).join(" · ")), list_of_costs);
    if (episode.note) place.append(make("p", { class: "note" }, episode.note));
    if (episode.why) place.append(make("div", { class: "why" }, make("strong", {}, `Why it failed (${words(episode.failure)}): `), episode.why.text));
    const told = goals(episode);
    if (told) place.append(told);
    if (episode.message) place.append(make("h3", {}, "Error"), make("pre", {}, episode.message));
    if (episode.trace.length) place.append(steps(episode));
  }

  // ---- putting it together

  function refresh() {
    at("q").value = state.q;
    for (const key of SELECTS) at(key).value = state[key];
    for (const column of COLUMNS) {
      if (column.key === state.sort) at(`sort-${column.key}`).setAttribute("aria-sort", state.desc ? "descending" : "ascending");
      else at(`sort-${column.key}`).removeAttribute("aria-sort");
    }
    toAddress();
    filter();
    list.scrollTop = Math.min(list.scrollTop, shown.length * ROW);
    reveal();
    draw(true);
  }

  function open(number) {
    state.episode = String(number);
    toAddress();
    reveal();
    draw(true);
    detail();
  }

  at("q").addEventListener("input", () => { state.q = at("q").value; refresh(); });
  for (const key of SELECTS) at(key).addEventListener("change", () => { state[key] = at(key).value; refresh(); });
  at("filters").addEventListener("submit", (event) => event.preventDefault());
  at("filters").addEventListener("reset", (event) => {
    event.preventDefault();
    for (const key of ["q", ...SELECTS]) state[key] = "";
    refresh();
  });
  list.addEventListener("scroll", () => draw(false), { passive: true });
  addEventListener("resize", () => draw(false));
  addEventListener("hashchange", () => { fromAddress(); refresh(); detail(); });
  addEventListener("beforeprint", () => { everything = true; draw(true); });
  addEventListener("afterprint", () => { everything = false; draw(true); });
  at("rows").addEventListener("keydown", (event) => {
    if (event.target !== at("rows") || event.ctrlKey || event.metaKey || event.altKey) return;
    const here = position();
    const page = Math.max(1, Math.floor(list.clientHeight / ROW) - 1);
    const target = { ArrowDown: here + 1, ArrowUp: here < 0 ? 0 : here - 1, PageDown: here + page, PageUp: here - page, Home: 0, End: shown.length - 1 }[event.key];
    if (target === undefined || !shown.length) return;
    event.preventDefault();
    open(shown[Math.min(shown.length - 1, Math.max(0, target))].number);
  });

  fromAddress();
  refresh();
  detail();
})();
