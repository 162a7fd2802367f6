// What `scripts/check-dashboard` does in the browser.

import assert from "node:assert/strict";
import { spawn, spawnSync } from "node:child_process";
import { closeSync, mkdirSync, openSync, readFileSync, writeFileSync, writeSync } from "node:fs";
import { createRequire } from "node:module";
import { join } from "node:path";

const { CHROMIUM, MODULES, PLACE, RATN, SHOTS } = process.env;
const MIB = Number(process.env.MIB);
const { chromium } = createRequire(join(MODULES, "x.js"))("playwright-core");
const AXE = readFileSync(join(MODULES, "axe-core/axe.min.js"), "utf8");
const PATIENCE_MS = 60_000;
/** A name that would do something wherever it is taken for markup or code. */
const INJECTED = `<img src=x onerror="window.hit=1"></script><script>window.hit=2</script>{{7*7}}'"`;

const running = [];
function start(name, args, env = {}) {
  const child = spawn(RATN, args, { env: { ...process.env, ...env }, stdio: ["ignore", "pipe", "pipe"] });
  const said = { out: "", error: "" };
  child.stdout.on("data", (part) => (said.out += part));
  child.stderr.on("data", (part) => (said.error += part));
  const ended = new Promise((resolve) => child.on("exit", (code) => resolve(code)));
  const one = { name, child, said, ended };
  running.push(one);
  return one;
}

async function until(what, look, patience = PATIENCE_MS) {
  const end = Date.now() + patience;
  for (;;) {
    const found = await look();
    if (found) return found;
    if (Date.now() > end) throw new Error(`not within ${patience / 1000} s: ${what}`);
    await new Promise((resolve) => setTimeout(resolve, 100));
  }
}

async function dashboard(args) {
  const one = start("dashboard", ["dashboard", ...args]);
  const url = await until("the dashboard's address", () => {
    assert.equal(one.child.exitCode, null, one.said.error);
    return one.said.out.match(/http:\S+/)?.[0];
  });
  return { ...one, url };
}

function step(text) {
  console.log(`${((performance.now() - began) / 1000).toFixed(1).padStart(6)} s  ${text}`);
}
const began = performance.now();

const browser = await chromium.launch({ executablePath: CHROMIUM, args: ["--no-sandbox", "--disable-dev-shm-usage", "--enable-unsafe-swiftshader"] });

async function open(url, options = {}) {
  const context = await browser.newContext({ viewport: { width: 1280, height: 760 }, colorScheme: "light", ...options });
  const page = await context.newPage();
  page.setDefaultTimeout(PATIENCE_MS);
  const problems = [];
  page.on("pageerror", (error) => problems.push(String(error)));
  page.on("console", (message) => {
    // A refusal is told on the page; everything else that a page complains of is an error of ours.
    if (message.type() === "error" && !message.text().includes("Failed to load resource")) problems.push(message.text());
  });
  page.on("dialog", (dialog) => problems.push(`a dialog: ${dialog.message()}`));
  page.problems = problems;
  await page.goto(url);
  await page.waitForSelector("footer output:not(:empty), .summary:not(:empty)");
  return page;
}

async function go(page, name) {
  await page.click(`nav a[href="#/${name}"]`);
  await page.waitForFunction((name) => document.querySelector(`nav a[href="#/${name}"]`)?.getAttribute("aria-current") === "page", name);
  await page.waitForTimeout(["hosts", "resources", "world", "cell"].includes(name) ? 1500 : 500);
}

async function axe(page, what) {
  // From outside of the page's own policy, as an extension would.
  const world = await page.context().newCDPSession(page);
  const { frameTree } = await world.send("Page.getFrameTree");
  const { executionContextId } = await world.send("Page.createIsolatedWorld", { frameId: frameTree.frame.id, worldName: "axe" });
  const run = (expression) => world.send("Runtime.evaluate", { expression, contextId: executionContextId, awaitPromise: true, returnByValue: true });
  await run(AXE);
  const { result, exceptionDetails } = await run(
    `axe.run(document, { resultTypes: ["violations"] }).then((found) => found.violations.map((one) => one.id + ": " + one.help + ": " + one.nodes.map((node) => node.html.slice(0, 120)).join(" | ")))`,
  );
  await world.detach();
  assert.equal(exceptionDetails, undefined, JSON.stringify(exceptionDetails));
  assert.deepEqual(result.value, [], `axe on ${what}`);
}

/** On a phone in landscape nothing is wider than it, and what steers and what chooses is in view. */
async function fitsPhone(page, name) {
  const { wide, tall, beyond } = await page.evaluate(() => ({
    wide: document.documentElement.scrollWidth - innerWidth,
    tall: document.querySelector("main").clientHeight,
    beyond: [...document.querySelectorAll("header.top > :not(.skip), header.top button, header.top a[aria-current=page]")]
      .filter((one) => one.getBoundingClientRect().right > innerWidth || one.getBoundingClientRect().left < 0)
      .map((one) => one.textContent),
  }));
  assert.ok(wide <= 0, `${name} is ${wide} px wider than the phone`);
  assert.ok(tall >= 220, `${name} has ${tall} px for itself`);
  assert.deepEqual(beyond, [], `${name} on a phone: cut off in the line at the top`);
}

async function shot(page, name) {
  await page.screenshot({ path: join(SHOTS, `${name}.png`) });
}

const at = (seconds) => Math.round(seconds * 1e9);
const line = (value) => `${JSON.stringify(value)}\n`;
const startedLine = (task, more = {}) =>
  line({ at: 0, event: "started", task, digest: "d", mode: "cdtn", parameters: {}, seed: 1, world: [], revision: 0, capacity: { PathPlanner: 2 }, origin: { run: "r", natures: { computes: ["place/plan"], actuating: ["Arm"] } }, ...more });

/** `place[n]/plan` on one of two planners, then `place[n]/move` with the arm. */
function visits(write, count) {
  let id = 0;
  const note = (when, note, more) => write(line({ at: at(when), command: "note", note, ...more }));
  for (let n = 1; n <= count / 2; n += 1) {
    const [plan, move] = [(id += 1), (id += 1)];
    const t = n * 2;
    note(t - 1.9, "expanded", { instance: plan, state: 1, path: `place[${n}]/plan`, speculative: n % 7 === 0 });
    note(t - 1.9, "expanded", { instance: move, state: 2, path: `place[${n}]/move`, speculative: n % 7 === 0 });
    const begin = (when, instance, lease, resource, kind, action, projection) => {
      const resources = [{ id: resource, kind, endpoint: "" }];
      write(line({ at: at(when - 0.1), command: "acquire", instance, requirements: [{ operation: "block", kind, class: null, attributes: {}, count: 1 }], priority: 1 }));
      write(line({ at: at(when), event: "granted", instance, lease: { id: lease, token: lease, resources } }));
      write(line({ at: at(when), command: "start", instance, attempt: 1, goal: { provider: kind, action, inputs: {}, seed: 1, lease: { id: lease, token: lease, resources }, projection, expected_s: null } }));
    };
    const end = (when, instance, lease) => {
      write(line({ at: at(when), event: "finished", instance, attempt: 1, outcome: "success", outputs: {}, measured: [], reason: "" }));
      note(when, "finished", { instance, outcome: "success" });
      write(line({ at: at(when), command: "release", instance, lease, projection: null }));
    };
    begin(t - 1.8, plan, plan, `planner-${1 + (n % 2)}@compute`, "PathPlanner", "plan", 1);
    end(t - 1, plan, plan);
    begin(t - 0.9, move, move, "arm@sim", "Arm", "move", null);
    end(t - 0.1, move, move);
    note(t - 0.1, "retired", { instance: plan });
    if (n % 9 === 0) note(t - 0.05, "squashed", { instance: move });
    else note(t - 0.05, "retired", { instance: move });
  }
}

async function control() {
  const directory = join(PLACE, "run");
  mkdirSync(directory);
  const up = start("up", ["up", "--runtime-dir", directory, "--boxes", "2", "--speed", "4", "--dashboard"]);
  await until("the system", () => {
    assert.equal(up.child.exitCode, null, up.said.error);
    return up.said.error.includes("is ready");
  });
  const own = await until("the address of its own dashboard", () => up.said.error.match(/its dashboard is at (http:\S+)/)?.[1]);
  assert.equal((await fetch(own)).status, 200);
  const shown = await dashboard(["--runtime-dir", directory, "--control"]);
  const page = await open(shown.url);
  await page.waitForFunction(() => document.querySelector(".summary")?.textContent.includes("No run is under way"));
  assert.ok(!page.url().includes("token"), "the token is out of the address");
  step("a system without a run is shown");

  const log = join(PLACE, "live.jsonl");
  const run = start("run", ["run", "examples/fetch_boxes.yaml", "--runtime-dir", directory, "--set", "boxes=2", "--log", log, "--quiet"]);
  await page.waitForSelector(".badge.live");
  await page.waitForSelector("#running button");
  step("a run is started, and seen");
  await page.waitForFunction(() => Number.parseFloat(document.querySelector("footer output").textContent) > 8);
  await axe(page, "the run");
  await shot(page, "run-live");

  // Nothing is told to it before it is confirmed.
  await page.click("text=Pause");
  await page.waitForSelector("dialog[open]");
  await axe(page, "the question");
  await shot(page, "question");
  await page.click("dialog button[value=no]");
  await page.waitForTimeout(600);
  assert.equal(await page.locator(".badge.paused").count(), 0);
  await page.click("text=Pause");
  await page.click("dialog button[value=yes]");
  await page.waitForSelector(".badge.paused");
  step("it is paused, once that was confirmed");
  const phone = await open(shown.url, { viewport: { width: 740, height: 360 }, hasTouch: true });
  await phone.waitForSelector(".badge.paused");
  await phone.waitForSelector("header .danger");
  for (const name of ["run", "cell"]) {
    await go(phone, name);
    await axe(phone, `${name} of a run that can be steered, on a phone`);
    await shot(phone, `phone-${name}`);
    await fitsPhone(phone, name);
  }
  assert.deepEqual(phone.problems, []);
  await phone.context().close();
  await go(page, "network");
  const why = await until("a sentence that says why something waits", async () => {
    const texts = await page.locator("#waiting li").allTextContents();
    return texts.find((text) => text.includes("the operator: the run is paused"));
  });
  step(`it says why something waits: ${why.trim()}`);
  await page.locator("#waiting button").first().click();
  await page.waitForSelector("[data-chosen]");
  await shot(page, "network-paused");
  await axe(page, "the network");

  await go(page, "hosts");
  const worker = await until("a worker", () => page.locator("tbody tr", { hasText: "path-planner" }).filter({ hasText: "@" }).filter({ hasText: "show" }).first().locator("td").first().textContent());
  const id = worker.trim();
  const row = page.locator("tbody tr", { hasText: id });
  const pid = Number((await row.locator("td").nth(3).textContent()).trim());
  process.kill(pid, "SIGKILL");
  await until("the worker to be replaced", async () => {
    const rows = await page.locator("tbody tr").filter({ hasText: "path-planner-" }).filter({ hasText: "ready" }).allTextContents();
    return rows.length > 0 && rows.every((text) => !text.includes(String(pid)));
  });
  await until("the restart to be counted", async () => {
    const pools = await page.locator("tbody tr").filter({ hasText: "path-planner" }).filter({ hasNotText: "show" }).first().locator("td").allTextContents();
    return Number(pools[6]) >= 1;
  });
  step(`worker ${id} was killed, and is seen replaced`);
  await page.click("[aria-label='Scale the pool path-planner']");
  await axe(page, "the question how many");
  await page.fill("dialog label:has-text('At least') input", "3");
  await page.click("dialog button[value=yes]");
  await until("a third planner", async () => (await page.locator("tbody tr").filter({ hasText: "path-planner-" }).filter({ hasText: "show" }).count()) >= 3);
  step("a pool is scaled, once that was confirmed");
  await page.locator("tbody tr", { hasText: "path-planner" }).locator("button", { hasText: "show" }).first().click();
  await page.waitForSelector("pre");
  await axe(page, "hosts and pools");
  await shot(page, "hosts");
  await go(page, "resources");
  await page.waitForFunction(() => document.body.textContent.includes("Resources of the system"));
  await axe(page, "resources");
  await shot(page, "resources");
  await go(page, "world");
  await page.waitForFunction(() => document.querySelectorAll("tbody tr").length > 5);
  await axe(page, "the world");
  await shot(page, "world");
  await go(page, "cell");
  await page.waitForFunction(() => document.querySelector("aside")?.textContent.includes("Objects as they are"));
  await page.waitForFunction(() => Number(document.querySelector("canvas")?.dataset.solids) > 15);
  await page.waitForFunction(() => document.querySelector("aside")?.textContent.includes("aimm, as the log says"));
  await axe(page, "the cell of a run");
  await shot(page, "cell-live");
  step("the cell is shown in 3D, with the objects as the running cell says that they are");
  await go(page, "run");

  await page.click("text=Step");
  await page.click("dialog button[value=yes]");
  await page.waitForTimeout(1500);
  assert.ok(readFileSync(log, "utf8").includes("step_requested"));
  // A breakpoint is set in the list of states, by keys alone, and once that was confirmed.
  await go(page, "network");
  await page.locator("summary:has-text('Breakpoints')").press("Enter");
  const listed = page.locator('[data-key="break for_box/release"]');
  assert.equal(await page.locator('[data-key="break for_box/plan_transfer"]').count(), 0, "what computes cannot be stopped at");
  await listed.press("Enter");
  await page.waitForSelector("dialog[open]");
  await axe(page, "the question whether to set a breakpoint");
  await page.locator("dialog button[value=no]").press("Enter");
  await page.waitForTimeout(600);
  assert.equal(await listed.getAttribute("aria-pressed"), "false");
  await listed.press("Enter");
  await page.locator("dialog button[value=yes]").press("Enter");
  await page.waitForSelector('[data-key="break for_box/release"][aria-pressed=true]');
  await page.waitForFunction(() => document.querySelector(".summary")?.textContent.includes("breakpoints: for_box/release"));
  await axe(page, "the network with breakpoints");
  await shot(page, "breakpoints");
  const fromOutside = spawnSync(RATN, ["control", "break", "for_box/grasp", "--runtime-dir", directory], { encoding: "utf8" });
  assert.equal(fromOutside.status, 0, fromOutside.stderr);
  await page.waitForFunction(() => document.querySelector(".summary")?.textContent.includes("breakpoints: for_box/release, for_box/grasp"));
  step("a breakpoint is set, once that was confirmed; one that somebody else has set is shown, too");
  await page.locator("summary:has-text('Breakpoints')").press("Enter");
  await page.click("text=Go on");
  await page.click("dialog button[value=yes]");
  await page.waitForFunction(() => document.querySelector(".summary .badge")?.textContent.startsWith("paused before for_box["));
  const stopped = await page.locator(".summary .badge").textContent();
  await page.locator('[data-key="unchoose"]').press("Enter");
  await page.locator("#waiting button", { hasText: "the run is paused at a breakpoint here" }).first().click();
  await page.waitForSelector("[data-chosen]");
  await shot(page, "breakpoint-stopped");
  await axe(page, "a run that has stopped at a breakpoint");
  await page.locator('aside [data-key="breakpoint"]').press("Enter");
  await page.locator("dialog button[value=yes]").press("Enter");
  await page.waitForFunction(() => document.querySelector('aside [data-key="breakpoint"]')?.textContent === "Pause before it");
  step(`the run is ${stopped}; there its breakpoint is taken away`);
  await page.locator("summary:has-text('Breakpoints')").press("Enter");
  await page.locator("details[open] li button").first().press("Enter");
  await page.locator("dialog button[value=yes]").press("Enter");
  await page.waitForFunction(() => !document.querySelector(".summary")?.textContent.includes("breakpoints:"));
  await page.locator("summary:has-text('Breakpoints')").press("Enter");
  await go(page, "run");
  await page.click("text=Go on");
  await page.click("dialog button[value=yes]");
  await page.waitForFunction(() => document.querySelector(".badge.live") !== null);
  step("it did a step, and goes on");
  await page.click("text=End the run");
  await page.click("dialog button[value=yes]");
  await run.ended;
  await page.waitForFunction(() => document.querySelector(".summary .badge.bad")?.textContent === "preempted");
  assert.equal(await page.locator("header .danger").count(), 0, "an ended run cannot be told anything");
  step("it is ended");
  await shot(page, "run-ended");

  const asks = join(PLACE, "hand_over.yaml");
  writeFileSync(
    asks,
    `task: hand_over
states:
  - lid: { wait: { signal: lid } }
  - go_on: { ask: { question: "May the arm move <b>now</b>?", choices: [now, never] } }
`,
  );
  const second = start("run", ["run", asks, "--runtime-dir", directory, "--log", join(PLACE, "asks.jsonl"), "--quiet"]);
  await page.waitForFunction(() => document.querySelector(".questions")?.textContent.includes("waits for the signal lid"));
  await page.click("text=Send it");
  await page.click("dialog button[value=yes]");
  await page.waitForFunction(() => document.querySelector(".questions")?.textContent.includes("May the arm move <b>now</b>?"));
  await axe(page, "a question of a state");
  await shot(page, "questions");
  await page.click(".questions button:has-text('now')");
  await page.click("dialog button[value=yes]");
  assert.equal(await second.ended, 0);
  await page.waitForFunction(() => document.querySelector(".summary .badge")?.textContent === "success");
  assert.ok(readFileSync(join(PLACE, "asks.jsonl"), "utf8").includes('"choice":"now"'));
  step("a run that begins is shown; its signal was sent and its question answered");
  assert.deepEqual(page.problems, []);
  await page.context().close();
  shown.child.kill("SIGTERM");
  up.child.kill("SIGTERM");
  await Promise.all([shown.ended, up.ended]);
  return log;
}

async function replay(log) {
  const shown = await dashboard([log, "crates/report/src/fixtures/incidents.jsonl", "--runtime-dir", join(PLACE, "nothing")]);
  const page = await open(shown.url);
  assert.equal(await page.locator("header .danger").count(), 0, "pages only look");
  await page.waitForFunction(() => document.querySelector("footer output").textContent.length > 3);
  await page.locator("footer input[type=range]").evaluate((slider) => {
    slider.value = String(Number(slider.max) * 0.4);
    slider.dispatchEvent(new Event("input"));
  });
  await page.waitForSelector(".badge:has-text('replayed')");
  const before = await page.locator("footer output").textContent();
  await page.selectOption("footer select", "10");
  await page.click("footer >> text=Play");
  await until("the replay to go on", async () => (await page.locator("footer output").textContent()) !== before);
  step(`a log is replayed: from ${before} on`);
  await page.click("footer >> text=Stop");
  await shot(page, "replay");

  // What is pointed at says what it did and what it waited for; a click goes to its node.
  const canvas = await page.locator("canvas").boundingBox();
  let hint = "";
  for (let x = 180; x < canvas.width && !hint.includes("waited"); x += 8) {
    for (const y of [32, 52, 72]) {
      await page.mouse.move(canvas.x + x, canvas.y + y);
      if (await page.locator(".tip").isVisible()) hint = await page.locator(".tip").textContent();
      if (hint.includes("waited")) break;
    }
  }
  assert.match(hint, /waited [\d.]+\s?s for /, "a hint says what was waited for");
  await page.mouse.down();
  await page.mouse.up();
  await page.waitForFunction(() => location.hash === "#/network");
  assert.ok(hint.startsWith(await page.locator("[data-chosen]").textContent()), hint);
  step(`pointed at, a bar says: ${hint.split("\n").join("; ")}`);
  await go(page, "run");

  // By keys alone: the chart is reached, a bar chosen and its node opened.
  await page.locator("canvas").focus();
  await page.keyboard.press("ArrowRight");
  await page.keyboard.press("Enter");
  await page.waitForFunction(() => location.hash === "#/network");
  await page.waitForSelector("[data-chosen]");
  await page.click("text=Only its causes");
  await page.waitForTimeout(500);
  await shot(page, "network-causes");
  await page.selectOption("label:has-text('Show') select", "states");
  await page.click("text=Only its causes");
  await page.waitForTimeout(500);
  await shot(page, "network-states");
  step("a bar is chosen by keys, its node opened, its causes shown");
  for (const by of ["node", "host"]) {
    await go(page, "run");
    await page.selectOption("label:has-text('A row is') select", by);
    await page.waitForTimeout(300);
    await shot(page, `run-by-${by}`);
  }
  await page.click("footer >> text=End");
  await go(page, "compare");
  await page.waitForFunction(() => document.querySelectorAll("main h2")[1]?.textContent.includes(":") && document.querySelectorAll("main canvas").length === 2);
  await axe(page, "two runs below each other");
  await page.waitForTimeout(1200);
  await shot(page, "compare");
  step("two logs are shown below each other");
  assert.deepEqual(page.problems, []);
  await page.context().close();

  const dark = await open(shown.url, { colorScheme: "dark", locale: "de-DE", viewport: { width: 844, height: 390 } });
  await dark.waitForFunction(() => /\d,\d/.test(document.querySelector("footer output").textContent));
  for (const name of ["run", "network", "resources", "world", "cell"]) {
    await go(dark, name);
    await axe(dark, `${name}, dark, on a phone`);
    await shot(dark, `dark-phone-${name}`);
    await fitsPhone(dark, name);
  }
  assert.deepEqual(dark.problems, []);
  await dark.context().close();
  step("dark, in German, on a phone in landscape: axe finds nothing, and nothing is wider than it");
  shown.child.kill("SIGTERM");
  await shown.ended;
}

async function injected() {
  const log = join(PLACE, "injected.jsonl");
  const key = { predicate: INJECTED, arguments: [INJECTED] };
  writeFileSync(
    log,
    startedLine(INJECTED, { world: [[key, { string: INJECTED }], ...boxAt(INJECTED, [0.6, 0, 0.8])] }) +
      line({ at: 1, command: "note", note: "expanded", instance: 1, state: 1, path: `${INJECTED}/${INJECTED}`, speculative: true }) +
      line({ at: 1, command: "acquire", instance: 1, requirements: [{ operation: "block", kind: INJECTED, class: null, attributes: {}, count: 1 }], priority: 1 }) +
      line({ at: at(1), event: "granted", instance: 1, lease: { id: 1, token: 1, resources: [{ id: INJECTED, kind: INJECTED, endpoint: "" }] } }) +
      line({ at: at(1), command: "start", instance: 1, attempt: 1, goal: { provider: INJECTED, action: INJECTED, inputs: {}, seed: 1, lease: { id: 1, token: 1, resources: [{ id: INJECTED, kind: INJECTED, endpoint: "" }] }, projection: 1, expected_s: null } }) +
      line({ at: at(2), event: "finished", instance: 1, attempt: 1, outcome: INJECTED, outputs: {}, measured: [], reason: INJECTED }) +
      line({ at: at(2), command: "note", note: "invalidated", instance: 1, reason: INJECTED }) +
      line({ at: at(3), command: "end", outcome: INJECTED, outputs: {}, reason: INJECTED }),
  );
  const shown = await dashboard([log, "--runtime-dir", join(PLACE, "nothing")]);
  const page = await open(shown.url);
  await page.waitForFunction(() => document.querySelector(".summary b") !== null);
  for (const name of ["run", "network", "resources", "hosts", "world", "cell"]) {
    await go(page, name);
    if (name === "run" || name === "network") {
      await page.locator("canvas").focus();
      await page.keyboard.press("ArrowRight");
      await page.mouse.move(600, 300);
    }
    assert.equal(await page.evaluate(() => window.hit), undefined, `a name did something on ${name}`);
    assert.equal(await page.locator("img").count(), 0, `a name is markup on ${name}`);
    assert.ok((await page.textContent("body")).includes(INJECTED), `the name is shown as it is on ${name}`);
  }
  assert.deepEqual(page.problems, []);
  await page.context().close();
  shown.child.kill("SIGTERM");
  await shown.ended;
  step("names that would do something are text on every page");
}

const UPRIGHT = [0, 0, 0, 1];
const fact = (predicate, individual, value) => [{ predicate, arguments: [individual] }, value];
const boxAt = (name, position, size = [0.1, 0.08, 0.1]) => [
  fact("shape", name, { map: { type: { string: "box" }, size: { list: size.map((float) => ({ float })) } } }),
  fact("at", name, { pose: { position, quaternion_xyzw: UPRIGHT } }),
];

/** A box is taken and brought to the side, along two trajectories of 4 s each. */
function pickAndPlace() {
  const joints = [1, 2, 3, 4, 5, 6, 7].map((n) => `arm_joint_${n}`);
  const [home, taking, giving] = [[-1.57, -0.35, 0, 1.4, 0, -1.39, 0], [-1.57, -0.9, 0, 1.2, 0, -1.0, 0], [0.5, -0.9, 0, 1.2, 0, -1.0, 0]];
  const rest = Array(7).fill(0);
  const points = (from, to) => [{ time_s: 0, positions: from, velocities: rest }, { time_s: 4, positions: to, velocities: rest }];
  const lease = (id, kind) => ({ id: 1, token: 1, resources: [{ id, kind, endpoint: "" }] });
  const begin = (when, instance, path, provider, action, inputs, kind) =>
    line({ at: at(when), command: "note", note: "expanded", instance, state: instance, path, speculative: false }) +
    line({ at: at(when), command: "start", instance, attempt: 1, goal: { provider, action, inputs, seed: 1, lease: lease(`${provider}@sim`, kind), projection: null, expected_s: null } });
  const end = (when, instance, outputs) =>
    line({ at: at(when), event: "finished", instance, attempt: 1, outcome: "success", outputs, measured: [], reason: "" }) + line({ at: at(when), command: "note", note: "retired", instance });
  const follow = (when, instance, path, from, to) => begin(when, instance, path, "arm", "follow", { trajectory: { trajectory: { joints, points: points(from, to) } } }, "Arm") + end(when + 4, instance, { end: { joints: to } });
  const held = [...boxAt("parcel", [0.75, 0.2, 0.75]).slice(0, 1), fact("in_gripper", "parcel", { pose: { position: [0, 0, 0.02], quaternion_xyzw: UPRIGHT } })];
  return (
    startedLine("pick and place", { world: [fact("at", "base", { pose: { position: [0, 0, 0], quaternion_xyzw: UPRIGHT } }), ...boxAt("table", [0.8, 0, 0.675], [0.6, 1.2, 0.05]), ...boxAt("parcel", [0.75, 0.2, 0.75])], capacity: { Arm: 1, Base: 1 } }) +
    follow(1, 1, "approach", home, taking) +
    begin(5.1, 2, "grasp", "gripper", "grasp", { object: { string: "parcel" } }, "Gripper") +
    end(6, 2, { width_m: { float: 0.08 } }) +
    line({ at: at(6), event: "world_changed", revision: 1, facts: held }) +
    follow(6.5, 3, "transfer", taking, giving) +
    line({ at: at(12), command: "end", outcome: "success", outputs: {}, reason: "" })
  );
}

/** How many colours there are on the canvas in 3D, and what its pixels add up to, in the frame in which it was painted. */
async function painted(page, choose = () => false) {
  const { counts, all, sum } = await page.evaluate(async () => {
    const canvas = document.querySelector("canvas");
    // It paints in the next frame, before what is asked for after it.
    for (const key of ["+", "-"]) canvas.dispatchEvent(new KeyboardEvent("keydown", { key, bubbles: true, cancelable: true }));
    await new Promise(requestAnimationFrame);
    const gl = canvas.getContext("webgl2");
    const data = new Uint8Array(4 * gl.drawingBufferWidth * gl.drawingBufferHeight);
    gl.readPixels(0, 0, gl.drawingBufferWidth, gl.drawingBufferHeight, gl.RGBA, gl.UNSIGNED_BYTE, data);
    const counts = new Map();
    let sum = 0;
    for (let index = 0; index < data.length; index += 4) {
      const colour = (data[index] << 16) | (data[index + 1] << 8) | data[index + 2];
      counts.set(colour, (counts.get(colour) ?? 0) + 1);
      sum = (sum * 31 + colour) >>> 0;
    }
    return { counts: [...counts], all: data.length / 4, sum };
  });
  const chosen = counts.filter(([colour]) => choose(colour >> 16, (colour >> 8) & 255, colour & 255)).reduce((sum, [, count]) => sum + count, 0);
  return { colours: counts.length, background: Math.max(...counts.map(([, count]) => count)) / all, sum, chosen };
}

/** Two fingers go apart. */
async function pinch(page, x, y) {
  const world = await page.context().newCDPSession(page);
  const fingers = (apart) => [x - apart, x + apart].map((x, id) => ({ x, y, id }));
  await world.send("Input.dispatchTouchEvent", { type: "touchStart", touchPoints: fingers(40) });
  for (const apart of [60, 80, 100]) await world.send("Input.dispatchTouchEvent", { type: "touchMove", touchPoints: fingers(apart) });
  await world.send("Input.dispatchTouchEvent", { type: "touchEnd", touchPoints: [] });
  await world.detach();
}

async function cell() {
  const log = join(PLACE, "pick.jsonl");
  writeFileSync(log, pickAndPlace());
  const shown = await dashboard([log, "--runtime-dir", join(PLACE, "nothing")]);
  const page = await open(shown.url, { hasTouch: true });
  const asked = [];
  page.on("request", (request) => asked.push(new URL(request.url()).pathname));
  await page.waitForFunction(() => document.querySelector("footer output").textContent.length > 3);
  assert.ok(!asked.includes("/cell.js"), "only its page loads it");
  await go(page, "cell");
  assert.ok(asked.includes("/cell.js"));
  await page.waitForFunction(() => Number(document.querySelector("canvas")?.dataset.solids) > 15);
  const whole = await painted(page);
  assert.ok(whole.colours > 50 && whole.background < 0.97, JSON.stringify(whole));
  assert.equal((await painted(page)).sum, whole.sum, "what does not change is painted as before");
  const canvas = await page.locator("canvas").boundingBox();
  const [x, y] = [canvas.x + canvas.width / 2, canvas.y + canvas.height / 2];
  const drag = async () => {
    await page.mouse.move(x, y);
    await page.mouse.down();
    await page.mouse.move(x + 80, y + 30, { steps: 4 });
    await page.mouse.up();
  };
  await page.locator("canvas").focus();
  let before = whole.sum;
  for (const [what, act] of [
    ["a drag turns", drag],
    ["with Shift it moves", async () => (await page.keyboard.down("Shift"), await drag(), await page.keyboard.up("Shift"))],
    ["the wheel zooms", () => page.mouse.wheel(0, -300)],
    ["an arrow key turns", () => page.keyboard.press("ArrowLeft")],
    ["with Shift it moves", () => page.keyboard.press("Shift+ArrowLeft")],
    ["a key zooms", () => page.keyboard.press("+")],
    ["two fingers zoom", () => pinch(page, x, y)],
  ]) {
    await act();
    await page.waitForTimeout(150);
    const { sum } = await painted(page);
    assert.notEqual(sum, before, what);
    before = sum;
  }
  await page.keyboard.press("0");
  await page.waitForTimeout(150);
  assert.equal((await painted(page)).sum, whole.sum, "0 shows all, as at first");
  step(`the cell is painted: ${whole.colours} colours, ${((1 - whole.background) * 100).toFixed(0)} % of the canvas are not background`);

  const to = (seconds) =>
    page.locator("footer input[type=range]").evaluate((slider, seconds) => {
      slider.value = String(seconds);
      slider.dispatchEvent(new Event("input"));
    }, seconds);
  await to(8.5);
  await page.waitForFunction(() => document.querySelector("#moving")?.textContent.includes("transfer"));
  await page.waitForFunction(() => document.querySelector("aside").textContent.includes("Held: parcel"));
  const there = await painted(page);
  await page.locator("canvas").focus();
  await page.keyboard.press("0");
  await axe(page, "the cell");
  await shot(page, "cell");
  await to(7);
  await page.waitForFunction(() => Math.abs(Number(document.querySelector("canvas").dataset.moment) - 7) < 0.01);
  assert.notEqual((await painted(page)).sum, there.sum, "at another moment the arm is elsewhere");
  step("what moves is named, the box is held, and the arm is elsewhere at another moment");

  // Replayed, the arm goes on with every frame, by less than is seen.
  await page.click("footer >> text=Play");
  const moments = await page.evaluate(async () => {
    const moments = [];
    for (const end = performance.now() + 3000; performance.now() < end; ) {
      await new Promise(requestAnimationFrame);
      moments.push(Number(document.querySelector("canvas").dataset.moment));
    }
    return moments.slice(Math.floor(moments.length / 3));
  });
  await page.click("footer >> text=Stop");
  const steps = moments.slice(1).map((moment, index) => moment - moments[index]);
  assert.ok(steps.every((one) => one >= 0 && one < 0.5), `it jumps: ${steps.join(" ")}`);
  const distinct = new Set(moments).size;
  assert.ok(distinct > 8, `${distinct} pictures in 2 s`);
  step(`a replay shows ${distinct} pictures in 2 s; from one to the next it goes on by ${Math.max(...steps).toFixed(2)} s at the most`);
  assert.deepEqual(page.problems, []);
  await page.context().close();

  const dark = await open(shown.url, { colorScheme: "dark", hasTouch: true });
  await go(dark, "cell");
  await dark.waitForFunction(() => Number(document.querySelector("canvas")?.dataset.solids) > 15);
  assert.notEqual((await painted(dark)).sum, whole.sum, "it follows the colours of the system");
  await axe(dark, "the cell, dark");
  await shot(dark, "cell-dark");
  await dark.context().close();

  const without = await open(shown.url);
  await without.addInitScript(() => {
    const own = HTMLCanvasElement.prototype.getContext;
    HTMLCanvasElement.prototype.getContext = function (kind, ...more) {
      return kind === "webgl2" ? null : own.call(this, kind, ...more);
    };
  });
  await without.reload();
  await go(without, "cell");
  await without.waitForSelector("#no-webgl");
  await without.waitForFunction(() => document.querySelector("aside").textContent.includes("parcel"));
  await axe(without, "the cell without WebGL");
  assert.deepEqual(without.problems, []);
  await without.context().close();
  shown.child.kill("SIGTERM");
  await shown.ended;
  step("a browser without WebGL says so, and lists what would be shown");

  const other = await dashboard([log, "--robot", "ur5", "--runtime-dir", join(PLACE, "nothing")]);
  const unknown = await open(other.url);
  await go(unknown, "cell");
  await unknown.waitForFunction(() => document.querySelector("main .warn")?.textContent.includes("only objects and the base are shown"));
  await shot(unknown, "cell-unknown");
  assert.deepEqual(unknown.problems, []);
  await unknown.context().close();
  other.child.kill("SIGTERM");
  await other.ended;
  step("of a log of another robot only the objects and the base are shown, and why");

  const named = (robot, name) => {
    const file = join(PLACE, name);
    writeFileSync(file, pickAndPlace().replace('"origin":{', `"origin":{"robot":${JSON.stringify(robot)},`));
    return file;
  };
  const logs = [named("aimm", "named.jsonl"), named("/nowhere/robot.toml", "away.jsonl")];
  const both = await dashboard([...logs, "--runtime-dir", join(PLACE, "nothing")]);
  const two = await open(both.url);
  await go(two, "cell");
  await two.waitForFunction(() => document.querySelector("aside")?.textContent.includes("aimm, as the log says"));
  await two.selectOption("header.top select", { label: "away.jsonl" });
  await two.waitForFunction(() => document.querySelector("main .warn")?.textContent.includes("the log is of the robot /nowhere/robot.toml"));
  assert.ok((await two.textContent("main .warn")).includes("--robot names another description of it"));
  await axe(two, "the cell of a robot that is not here");
  await shot(two, "cell-away");
  assert.deepEqual(two.problems, []);
  await two.context().close();
  both.child.kill("SIGTERM");
  await both.ended;
  step("a log is shown with the robot that it names, or says which one it needs");
}

/** A robot whose description says what is seen of it: meshes in their colours, and one that is not there. */
async function visuals() {
  const place = join(PLACE, "robot");
  mkdirSync(place);
  const mesh = (file, more) => `<visual><geometry><mesh filename="${file}"/></geometry>${more}</visual>`;
  const red = '<material name="red"><color rgba="1 0 0 1"/></material>';
  const seen = { base: mesh("tower.obj", red), arm_4: mesh("tower.obj", ""), hand: mesh("gone.stl", "") };
  let urdf = readFileSync("crates/motion/robots/aimm.urdf", "utf8");
  for (const [link, visual] of Object.entries(seen)) urdf = urdf.replace(`<link name="${link}">`, `$&${visual}`);
  writeFileSync(join(place, "aimm.urdf"), urdf);
  for (const file of ["aimm.toml", "aimm.srdf"]) writeFileSync(join(place, file), readFileSync(`crates/motion/robots/${file}`));
  // A tower of four sides, with a tip.
  writeFileSync(join(place, "tower.obj"), "v -.3 -.3 0\nv .3 -.3 0\nv .3 .3 0\nv -.3 .3 0\nv 0 0 .9\nf 1 2 5\nf 2 3 5\nf 3 4 5\nf 4 1 5\nf 4 3 2 1\n");
  const log = join(PLACE, "seen.jsonl");
  writeFileSync(log, pickAndPlace());
  const shown = await dashboard([log, "--robot", join(place, "aimm.toml"), "--runtime-dir", join(PLACE, "nothing")]);
  const page = await open(shown.url);
  const asked = [];
  page.on("request", (request) => request.url().includes("/api/mesh") && asked.push(new URL(request.url()).search));
  await go(page, "cell");
  await page.waitForFunction(() => document.querySelector("canvas")?.dataset.meshes === "2");
  assert.equal(asked.length, 1, `a mesh that two links show is asked for once: ${asked}`);
  await page.waitForFunction(() => document.querySelector("aside").textContent.includes("Not seen of it: hand: the mesh `gone.stl`"));
  const isRed = (red, green, blue) => red > 90 && red > 8 * green && red > 8 * blue;
  const drawn = await painted(page, isRed);
  assert.ok(drawn.chosen > 500, `${drawn.chosen} red points of the mesh`);
  await axe(page, "the cell of a robot with visuals");
  await shot(page, "cell-visuals");
  await page.click("text=What can collide");
  await page.waitForFunction(() => document.querySelector("canvas").dataset.meshes === "0");
  assert.equal((await painted(page, isRed)).chosen, 0, "what can collide has the colour of every robot");
  await page.click("text=What can collide");
  await page.waitForFunction(() => document.querySelector("canvas").dataset.meshes === "2");
  // A replay shows them where the joints are.
  await page.locator("footer input[type=range]").evaluate((slider) => {
    slider.value = "8.5";
    slider.dispatchEvent(new Event("input"));
  });
  await page.waitForFunction(() => document.querySelector("#moving")?.textContent.includes("transfer"));
  assert.notEqual((await painted(page, isRed)).sum, drawn.sum);
  assert.deepEqual(page.problems, []);
  await page.context().close();
  shown.child.kill("SIGTERM");
  await shown.ended;
  step(`a robot is drawn by the meshes of its description, in their colours: ${drawn.chosen} points are those of a red one`);
}

async function large() {
  const log = join(PLACE, "large.jsonl");
  const file = openSync(log, "w");
  writeSync(file, startedLine("large"));
  const parts = [];
  visits((text) => parts.push(text), 10_000);
  writeSync(file, parts.join(""));
  closeSync(file);
  const shown = await dashboard([log, "--runtime-dir", join(PLACE, "nothing")]);
  const page = await open(shown.url);
  await page.waitForFunction(() => document.querySelector("footer output").textContent.startsWith("10,000"));
  await page.waitForTimeout(1000);
  const frames = await page.evaluate(async () => {
    const view = document.querySelector(".canvas");
    const box = view.getBoundingClientRect();
    const times = [];
    let last = performance.now();
    for (let n = 0; n < 90; n += 1) {
      view.querySelector("canvas").dispatchEvent(new WheelEvent("wheel", { deltaY: n < 45 ? -20 : 20, ctrlKey: true, clientX: box.left + 500, clientY: box.top + 80, cancelable: true, bubbles: true }));
      await new Promise(requestAnimationFrame);
      times.push(performance.now() - last);
      last = performance.now();
    }
    return { painted: Number(view.querySelector("canvas").dataset.paintedMs), median: times.sort((a, b) => a - b)[45], slow: times[85] };
  });
  step(`10,000 bars are zoomed at ${(1000 / frames.median).toFixed(0)} frames a second (the slowest of twenty: ${frames.slow.toFixed(1)} ms); painting takes ${frames.painted} ms`);
  assert.ok(frames.median < 34, "10,000 bars are zoomed without waiting");
  await shot(page, "large-run");
  const before = Date.now();
  await page.click('nav a[href="#/network"]');
  await page.waitForFunction(() => Number(document.querySelector(".canvas")?.dataset.nodes) >= 9_999 && document.querySelector("canvas").dataset.paintedMs !== undefined);
  const took = Date.now() - before;
  step(`a network of 10,000 instances is laid out and painted in ${took} ms`);
  assert.ok(took < 2_000, `${took} ms`);
  const painted = await page.evaluate(() => {
    const canvas = document.querySelector("canvas");
    const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
    let [inked, all] = [0, 0];
    for (let index = 3; index < data.length; index += 4) [inked, all] = [inked + (data[index] > 60 ? 1 : 0), all + 1];
    return inked / all;
  });
  assert.ok(painted > 0.02, `${(painted * 100).toFixed(2)} % of the network is painted`);
  await shot(page, "large-network");
  assert.deepEqual(page.problems, []);
  await page.context().close();
  shown.child.kill("SIGTERM");
  await shown.ended;
}

async function long() {
  const log = join(PLACE, "long.jsonl");
  const file = openSync(log, "w");
  writeSync(file, startedLine("long"));
  let [bytes, id, parts] = [0, 0, []];
  const ballast = "x".repeat(3000);
  while (bytes < MIB * (1 << 20)) {
    parts = [];
    for (let n = 0; n < 300; n += 1) {
      id += 1;
      const t = id * 0.1;
      parts.push(line({ at: at(t), command: "note", note: "expanded", instance: id, state: 1, path: `look[${id}]`, speculative: false }));
      parts.push(line({ at: at(t), command: "start", instance: id, attempt: 1, goal: { provider: "eye", action: "look", inputs: {}, seed: 1, lease: null, projection: null, expected_s: null } }));
      parts.push(line({ at: at(t), event: "progressed", instance: id, attempt: 1, message: ballast }));
      parts.push(line({ at: at(t + 0.05), event: "finished", instance: id, attempt: 1, outcome: "success", outputs: {}, measured: [], reason: "" }));
      parts.push(line({ at: at(t + 0.05), command: "note", note: "retired", instance: id }));
    }
    bytes += writeSync(file, parts.join(""));
  }
  closeSync(file);
  const before = Date.now();
  const shown = await dashboard([log, "--runtime-dir", join(PLACE, "nothing")]);
  const page = await open(shown.url);
  await page.waitForFunction(() => document.querySelector(".summary .warn") !== null);
  const took = Date.now() - before;
  step(`a log of ${MIB} MiB is open in ${(took / 1000).toFixed(1)} s, from the start of the program on`);
  assert.ok(took < 5_000, `${took} ms`);
  const jump = Date.now();
  await page.locator("footer input[type=range]").evaluate((slider) => {
    slider.value = String(Number(slider.max) / 2);
    slider.dispatchEvent(new Event("input"));
  });
  const half = Math.floor((id * 0.1) / 2 / 100);
  await page.waitForFunction((half) => document.querySelector("footer output").textContent.replace(/\D/g, "").startsWith(String(half)), half);
  step(`and its middle is shown ${((Date.now() - jump) / 1000).toFixed(1)} s after it was asked for`);
  await shot(page, "long");
  assert.deepEqual(page.problems, []);
  await page.context().close();
  shown.child.kill("SIGTERM");
  await shown.ended;
}

/** A task file is looked at, changed in a form, and written. */
async function annotations() {
  const file = join(PLACE, "edited.yaml");
  const text = `task: edited # <b>\nworld: ["on(cup, table)"]\nstates:\n  - plan: # it plans\n      action: path_planner/plan\n      in: { start: "joints(0, 0, 0, 0, 0, 0, 0)", goal: "joints(1, 0, 0, 0, 0, 0, 0)" }\n      duration: 2 # s\n  - open: { action: gripper/release }\n`;
  writeFileSync(file, text);
  const shown = await dashboard(["--edit", file, "--runtime-dir", join(PLACE, "nothing")]);
  const page = await open(shown.url);
  await go(page, "annotations");
  const duration = page.locator('[data-key="duration 0"]');
  await duration.fill("nothing.here");
  await page.waitForSelector("#findings-duration .bad");
  assert.ok(await page.locator('[data-key="save"]').isDisabled());
  // What is typed is text wherever it is shown.
  await duration.fill(INJECTED);
  await page.waitForFunction((text) => document.querySelector("main pre")?.textContent.includes(text), "<img src=x onerror=");
  assert.equal(await page.evaluate(() => window.hit), undefined);
  assert.equal(await page.locator("main img").count(), 0);
  await duration.fill("4");
  await page.waitForFunction(() => document.querySelector("main")?.textContent.includes("by simulation in CDTN mode"));
  assert.ok(await page.locator('[data-key="save"]').isVisible());
  await axe(page, "Annotations");
  await shot(page, "annotations");
  assert.equal(readFileSync(file, "utf8"), text);
  await page.locator('[data-key="save"]').press("Enter");
  await page.waitForSelector("dialog[open]");
  await axe(page, "the question whether to save");
  await page.locator("dialog button[value=yes]").press("Enter");
  await until("the file is written", () => readFileSync(file, "utf8") === text.replace("duration: 2 #", "duration: 4 #"));
  await page.waitForFunction(() => document.querySelector('[data-key="duration 0"]')?.value === "4");
  step("a task file's annotations are changed in a form and written");

  // Individuals are offered for each place of a predicate, by keys alone; the base is one that the planner's action reads.
  const offered = (key) => page.locator(`#words-${key} option`).evaluateAll((options) => options.map((option) => option.value));
  await page.locator('[data-key="said reads"]').press("Space");
  await page.locator('[data-key="reads 0"]').press("End");
  await page.keyboard.type("on(");
  assert.deepEqual(await offered("reads"), ["on(base, ", "on(cup, ", "on(table, ", "on(?, "]);
  await page.keyboard.type("cup, ");
  assert.deepEqual(await offered("reads"), ["on(cup, base)", "on(cup, cup)", "on(cup, table)", "on(cup, ?)"]);
  await page.keyboard.type("table)");
  await page.waitForFunction(() => document.querySelector("main")?.textContent.includes("+       reads: "));
  // One name of two predicates.
  await page.locator('[data-key="reads 0"]').fill("in_gripper(");
  const held = ["base", "cup", "table", "?"];
  assert.deepEqual(await offered("reads"), [...held.map((one) => `in_gripper(${one})`), ...held.map((one) => `in_gripper(${one}, `)]);
  await page.keyboard.type("cup, ");
  assert.deepEqual(await offered("reads"), held.map((one) => `in_gripper(cup, ${one})`));
  step("individuals are offered for each place of a predicate");

  // Of an action that says nothing, and what few states say.
  await page.locator('[data-key="undo"]').press("Enter");
  await page.locator('[data-key="state open"]').press("Enter");
  await page.locator('[data-key="said pia"]').press("Space");
  await page.locator("summary:has-text('More annotations')").press("Enter");
  await page.locator('[data-key="said exceptional"]').press("Space");
  await page.waitForFunction(() => document.querySelector("main")?.textContent.includes("pia: true, exceptional: [aborted] }"));
  await axe(page, "Annotations, all of them");
  await shot(page, "annotations-more");
  await page.locator('[data-key="save"]').press("Enter");
  await page.locator("dialog button[value=yes]").press("Enter");
  await until("both are written", () => readFileSync(file, "utf8").endsWith("  - open: { action: gripper/release, pia: true, exceptional: [aborted] }\n"));
  await page.waitForFunction(() => document.querySelector('[data-key="state open"]')?.parentElement.textContent.includes("says pia, exceptional"));
  step("it is said that an action may change the environment, and which of its outcomes is exceptional");

  // What is typed while a change is saved stays, and is a change of the file as it is then.
  const late = async (route) => {
    await new Promise((resolve) => setTimeout(resolve, 800));
    await route.continue();
  };
  await page.route("**/api/annotations/save*", late);
  await page.locator('[data-key="said duration"]').press("Space");
  await page.locator('[data-key="duration 0"]').fill("6");
  await page.waitForFunction(() => document.querySelector('[data-key="save"]')?.disabled === false);
  await page.locator('[data-key="save"]').press("Enter");
  await page.locator("dialog button[value=yes]").press("Enter");
  await page.locator('[data-key="duration 0"]').fill("7");
  await until("what was saved is written", () => readFileSync(file, "utf8").includes("exceptional: [aborted], duration: 6 }"));
  // The file is read again; what is typed is checked anew then.
  await page.waitForFunction(() => document.querySelector('[data-key="state open"]')?.parentElement.textContent.includes("duration"));
  await page.waitForFunction(() => document.querySelector("pre")?.textContent.includes("duration: 7"));
  assert.equal(await page.locator('[data-key="duration 0"]').inputValue(), "7");
  // And goes on where it was.
  await page.keyboard.type("5");
  assert.equal(await page.locator('[data-key="duration 0"]').inputValue(), "75");
  await page.keyboard.press("Backspace");
  await page.unroute("**/api/annotations/save*", late);
  await page.waitForFunction(() => document.querySelector('[data-key="save"]')?.disabled === false);
  await page.locator('[data-key="save"]').press("Enter");
  await page.locator("dialog button[value=yes]").press("Enter");
  await until("it is written, too", () => readFileSync(file, "utf8").includes("exceptional: [aborted], duration: 7 }"));
  // The page has read what it wrote: there is nothing to undo.
  await page.waitForFunction(() => document.querySelector('[data-key="undo"]')?.disabled === true);
  step("what is typed while a change is saved is not lost");

  // A file that is refused already can be mended from here, step by step, and a text over several lines keeps its lines.
  const refused = text.replace("duration: 2 # s", "duration: no.where\n      requires:\n        - |-\n          exists on(cup,\n          table)\n        - no.where.either");
  writeFileSync(file, refused);
  await page.locator('[data-key="again"]').press("Enter");
  await page.waitForFunction(() => document.querySelector('[data-key="state plan"]')?.parentElement.textContent.includes("says requires"));
  await page.locator('[data-key="state plan"]').press("Enter");
  await page.waitForSelector("#findings-duration .bad");
  const long = page.locator('textarea[data-key="requires 0"]');
  assert.equal(await long.inputValue(), "exists on(cup,\ntable)");
  await page.locator('[data-key="duration 0"]').fill("2");
  await page.waitForFunction(() => document.querySelector("main")?.textContent.includes("still is with this change"));
  await page.waitForFunction(() => document.querySelector('[data-key="save"]')?.disabled === false);
  await axe(page, "Annotations of a file that is refused");
  await shot(page, "annotations-refused");
  await page.locator('[data-key="save"]').press("Enter");
  await page.locator("dialog button[value=yes]").press("Enter");
  await until("half of it is mended", () => readFileSync(file, "utf8") === refused.replace("duration: no.where", "duration: 2"));
  await page.waitForFunction(() => document.querySelector("#findings-duration .bad") === null);
  await long.press("Control+End");
  await page.keyboard.type(" # 2");
  await page.waitForFunction(() => document.querySelector("pre")?.textContent.includes("exists on(cup,\\ntable) # 2"));
  step("a file that was refused already is mended step by step; a text over several lines keeps them");

  // Somebody else writes it.
  writeFileSync(file, text);
  await page.locator('[data-key="undo"]').press("Enter");
  await page.locator('[data-key="again"]').press("Enter");
  await page.locator('[data-key="state plan"]').press("Enter");
  // What was read has no conditions any more.
  await page.waitForSelector('[data-key="requires 0"]', { state: "detached" });
  writeFileSync(file, `${text}# by somebody else\n`);
  await page.locator('[data-key="duration 0"]').fill("5");
  await page.waitForFunction(() => document.querySelector("main [role=alert]")?.textContent.includes("has changed on the disk"));
  await axe(page, "Annotations of a file that has changed");
  await page.locator("main [role=alert] button").click();
  await page.waitForFunction(() => document.querySelector('[data-key="duration 0"]')?.value === "2");
  assert.deepEqual(page.problems, []);
  await page.context().close();

  const dark = await open(shown.url, { colorScheme: "dark", locale: "de-DE", viewport: { width: 844, height: 390 } });
  await go(dark, "annotations");
  await dark.waitForSelector('[data-key="duration 0"]');
  await axe(dark, "Annotations, dark, on a phone");
  await shot(dark, "dark-phone-annotations");
  await fitsPhone(dark, "Annotations");
  assert.deepEqual(dark.problems, []);
  await dark.context().close();
  step("a file that somebody else has written is read again; dark, on a phone, axe finds nothing");
  shown.child.kill("SIGTERM");
  await shown.ended;
}

const only = process.env.ONLY?.split(",");
try {
  const wants = (name) => only === undefined || only.includes(name);
  const live = wants("control") ? await control() : "crates/report/src/fixtures/two_boxes.jsonl";
  if (wants("replay")) await replay(live);
  if (wants("cell")) await cell();
  if (wants("visuals")) await visuals();
  if (wants("annotations")) await annotations();
  if (wants("injected")) await injected();
  if (wants("large")) await large();
  if (wants("long")) await long();
  step("the dashboard is as it should be");
} catch (error) {
  for (const context of browser.contexts()) for (const page of context.pages()) await page.screenshot({ path: join(SHOTS, "failed.png") }).catch(() => {});
  console.error(error);
  for (const { name, said } of running) console.error(`--- ${name}: ${said.error.slice(-1500)}`);
  process.exitCode = 1;
} finally {
  await browser.close();
  for (const { child } of running) if (child.exitCode === null) child.kill("SIGTERM");
}
