// The page: every control, every format, invalid files, keys, and a comparison with the command's result for the same
// frame.

import assert from "node:assert/strict";
import { execFileSync, spawn } from "node:child_process";
import { once } from "node:events";
import { mkdtemp, readFile, writeFile, rm } from "node:fs/promises";
import { brotliCompressSync } from "node:zlib";
import { readdirSync, readFileSync } from "node:fs";
import { tmpdir } from "node:os";
import { join } from "node:path";
import { after, before, test } from "node:test";
import { Planish } from "../dist/index.js";
import { compare, launch, root, serve } from "./helpers.mjs";

const SHAPE = [160, 120];
const command = process.env.PLANISH ?? `${root}/../target/release/planish`;
let browser, server, page, folder, planish;
const errors = [];

before(async () => {
  server = await serve(`${root}/dist-page`);
  browser = await launch();
  page = await browser.newPage({ viewport: { width: 1280, height: 900 } });
  page.on("pageerror", (error) => errors.push(error.message));
  folder = await mkdtemp(join(tmpdir(), "planish-web-"));
  planish = await Planish.load({ wasm: await readFile(`${root}/dist/planish.wasm`), webgpu: false });
  await page.goto(server.address);
  await settled("simulated");
});

after(async () => {
  await browser?.close();
  await server?.close();
  await rm(folder, { recursive: true });
});

/** Waits until the page has smoothed the frame with this name. */
async function settled(name) {
  await page.waitForFunction((name) => {
    const said = document.querySelector("#status").textContent;
    return said.startsWith(name) && said.includes("points") && !document.body.hasAttribute("aria-busy");
  }, name, { timeout: 120_000 });
}

/** Changes a control and returns the pixels of the smoothed picture. */
async function change(work) {
  await page.evaluate(() => (document.querySelector("#status").textContent = ""));
  await work();
  await settled("");
  return pixels("#smoothed");
}

function pixels(selector) {
  return page.evaluate((selector) => {
    const canvas = document.querySelector(selector);
    const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
    let hash = 0;
    for (const value of data) hash = (hash * 31 + value) | 0;
    return `${canvas.width}x${canvas.height} ${hash}`;
  }, selector);
}

async function open(name, bytes) {
  await page.evaluate(() => (document.querySelector("#status").textContent = ""));
  await page.setInputFiles("#file", { name, mimeType: "application/octet-stream", buffer: Buffer.from(bytes) });
}

/** Encodes a small frame in a format. */
async function file(format) {
  const frame = planish.simulate(3, ...SHAPE);
  const result = await planish.smoothFrame(frame, { preset: "light" }, frame.assumedCamera);
  return planish.write(result, format, frame.assumedCamera);
}

test("the page is small", () => {
  const sizes = readdirSync(`${root}/dist-page/assets`).map((name) => brotliCompressSync(readFileSync(`${root}/dist-page/assets/${name}`)).length);
  const sum = sizes.reduce((sum, size) => sum + size, 0) + brotliCompressSync(readFileSync(`${root}/dist-page/index.html`)).length;
  console.log(`${sum} bytes by Brotli`);
  assert.ok(sum <= 400_000, `${sum}`);
});

test("every format can be opened with the button or by dropping a file", async () => {
  for (const format of ["pcd", "ply", "npy", "png"]) {
    await open(`frame.${format}`, await file(format));
    await settled(`frame.${format}`);
    assert.match(await page.textContent("#status"), /160x120, [\d,]+ points/);
    assert.equal(await page.isVisible("#camera-fields"), format === "png");
  }
  const bytes = Array.from(await file("ply"));
  await page.evaluate((bytes) => {
    const transfer = new DataTransfer();
    transfer.items.add(new File([new Uint8Array(bytes)], "dropped.ply"));
    document.dispatchEvent(new DragEvent("drop", { dataTransfer: transfer, bubbles: true, cancelable: true }));
  }, bytes);
  await settled("dropped.ply");
});

test("invalid files cause an error message and change nothing", async () => {
  const before = await pixels("#smoothed");
  for (const [name, bytes, said] of [
    ["nothing.pcd", [], /nothing\.pcd: .*empty/],
    ["noise.xyz1", [1, 2, 3, 4], /expected PCD/],
    ["cut.ply", (await file("ply")).slice(0, 400), /truncated|damaged/],
    ["cut.png", (await file("png")).slice(0, 200), /cut\.png: /],
  ]) {
    await open(name, bytes);
    await page.waitForFunction((name) => document.querySelector("#error").textContent.includes(name), name);
    assert.match(await page.textContent("#error"), said);
    assert.ok(await page.isVisible("#error"));
  }
  assert.equal(await pixels("#smoothed"), before);
  assert.match(await page.textContent("#status"), /^$|points/);
});

/** Drops files on the page without waiting for them. */
function drop(files) {
  return page.evaluate((files) => {
    const transfer = new DataTransfer();
    for (const [name, bytes] of files) transfer.items.add(new File([new Uint8Array(bytes)], name));
    document.dispatchEvent(new DragEvent("drop", { dataTransfer: transfer, bubbles: true, cancelable: true }));
  }, files.map(([name, bytes]) => [name, Array.from(bytes)]));
}

test("after several files are dropped quickly, only the last one is shown", async () => {
  const [png, ply] = [await file("png"), await file("ply")];
  const large = planish.simulate(5, 640, 480);
  const slow = planish.write(await planish.smoothFrame(large, { preset: "light" }, large.assumedCamera), "pcd", large.assumedCamera);
  await writeFile(join(folder, "slow.pcd"), slow);
  await page.setInputFiles("#file", join(folder, "slow.pcd"));
  await drop([["first.png", png]]);
  await drop([["last.ply", ply]]);
  await settled("last.ply");
  // Choose the large frame again, and drop another frame while it is being smoothed.
  const [chooser] = await Promise.all([page.waitForEvent("filechooser"), page.click("#file")]);
  await chooser.setFiles(join(folder, "slow.pcd"));
  await page.waitForFunction(() => document.querySelector("#raw").width === 640);
  await drop([["quick.png", png]]);
  await settled("quick.png");
  assert.match(await pixels("#smoothed"), /^160x120 /);
  assert.ok(await page.isHidden("#error"), await page.textContent("#error"));
  // Of two frames, the first is shown, with a message about the other.
  await drop([["one.ply", ply], ["two.ply", ply]]);
  await settled("one.ply");
  assert.match(await page.textContent("#error"), /2 frames were dropped: one\.ply is shown/);
});

test("if a frame cannot be smoothed, the previous picture disappears and saving is disabled", async () => {
  const old = await pixels("#smoothed");
  await page.selectOption('[name="sensor"]', "auto");
  const pcd = "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH 2\nHEIGHT 3\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS 6\nDATA ascii\n";
  await drop([["tiny.pcd", Buffer.from(`${pcd}${"0 0 1\n".repeat(6)}`)]]);
  await page.waitForFunction(() => document.querySelector("#status").textContent.includes("not smoothed"));
  assert.match(await page.textContent("#error"), /sensor/);
  assert.notEqual(await pixels("#smoothed"), old);
  for (const format of ["pcd", "ply", "png"]) assert.ok(await page.isDisabled(`[data-format="${format}"]`), format);
  await change(() => page.selectOption('[name="sensor"]', "kinect1"));
  assert.ok(await page.isEnabled('[data-format="ply"]'));
  assert.ok(await page.isHidden("#error"));
});

test("every control changes the picture; controls without effect are disabled and explained", async () => {
  await open("frame.png", await file("png"));
  await settled("frame.png");
  const seen = new Set([await pixels("#smoothed")]);
  const differs = async (work, what) => {
    const now = await change(work);
    assert.ok(!seen.has(now), what);
    seen.add(now);
  };
  await differs(() => page.selectOption('[name="preset"]', "light"), "light");
  await differs(() => page.selectOption('[name="preset"]', "strong"), "strong");
  await differs(() => page.selectOption('[name="preset"]', "paper"), "paper");
  assert.ok(await page.isDisabled('[name="strength"]'));
  assert.notEqual(await page.textContent('.why[data-of="strength"]'), "");
  await change(() => page.selectOption('[name="preset"]', ""));
  assert.ok(await page.isEnabled('[name="strength"]'));
  await differs(() => page.locator('[name="strength"]').fill("0.25"), "strength");
  await differs(() => page.selectOption('[name="window"]', "4"), "window");
  await differs(() => page.selectOption('[name="sensor"]', "d435"), "sensor");
  await differs(() => page.uncheck('[name="edges"]'), "edges");
  await page.evaluate(() => (document.querySelector("#camera-fields").open = true));
  await differs(() => page.fill('[name="fx"]', "200").then(() => page.press('[name="fx"]', "Tab")), "fx");
  for (const kind of ["depth", "normals"]) {
    await page.selectOption('[name="kind"]', kind);
    await page.waitForFunction(() => true);
    await page.waitForTimeout(300);
    const now = await pixels("#smoothed");
    assert.ok(!seen.has(now), kind);
    seen.add(now);
  }
  assert.ok(await page.evaluate(() => document.querySelector('[value="colour"]').disabled));
  await page.evaluate(() => document.querySelector('[name="fx"]').closest("form").reset());
});

test("a camera file sets the camera", async () => {
  await open("frame.png", await file("png"));
  await settled("frame.png");
  const before = await pixels("#smoothed");
  const camera = { name: "camera.json", mimeType: "application/json", buffer: Buffer.from('{"fx": 300, "fy": 300, "cx": 80, "cy": 60}') };
  const after = await change(() => page.setInputFiles("#camera-file", camera));
  assert.notEqual(after, before);
  // The camera is shown in the fields, is kept for the next frame of the same size, and is replaced by a dropped
  // camera.
  assert.equal(await page.inputValue('[name="fx"]'), "300");
  await drop([["next.png", await file("png")]]);
  await settled("next.png");
  assert.equal(await page.inputValue('[name="fx"]'), "300");
  assert.equal(await change(() => drop([["camera.json", camera.buffer]])), after);
  // A frame and its camera are dropped together, in either order.
  await drop([["camera.json", camera.buffer], ["both.png", await file("png")]]);
  await settled("both.png");
  await page.waitForFunction(() => document.querySelector('[name="fx"]').value === "300");
  await drop([["wrong.json", Buffer.from('{"fx": 1}')]]);
  await page.waitForFunction(() => /wrong\.json: .*fx, fy, cx and cy/.test(document.querySelector("#error").textContent));
});

test("a cloud without a grid is smoothed, and controls without effect are disabled", async () => {
  const lines = Array.from({ length: 4000 }, (_, i) => `${(i % 80) / 100} ${Math.floor(i / 80) / 100} ${1 + 0.002 * Math.sin(i * 12.9898)}`);
  await open("scan.xyz", Buffer.from(lines.join("\n")));
  await settled("scan.xyz");
  for (const name of ["strength", "sensor", "window"]) assert.ok(await page.isDisabled(`[name="${name}"]`), name);
  assert.match(await page.textContent("#status"), /4,000 points/);
  // Edges have the command's default, and the picture is not black.
  assert.ok(!(await page.isChecked('[name="edges"]')));
  assert.equal((await pixels("#raw")).split(" ")[0], (await pixels("#smoothed")).split(" ")[0]);
  const bright = await page.evaluate(() => {
    const canvas = document.querySelector("#raw");
    const { data } = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
    const lit = data.filter((value, i) => i % 4 === 0 && data[i + 3] > 0);
    return lit.reduce((sum, value) => sum + value, 0) / lit.length;
  });
  assert.ok(bright > 120, `${bright}`);
  await drop([["frame.png", await file("png")]]);
  await settled("frame.png");
  assert.ok(await page.isChecked('[name="edges"]'));
});

test("keys move the divider and turn the cloud", async () => {
  await page.focus("#divider");
  await page.keyboard.press("ArrowRight");
  assert.equal(await page.evaluate(() => document.querySelector("#pictures").style.getPropertyValue("--split")), "51%");
  await page.selectOption('[name="layout"]', "cloud");
  await page.waitForFunction(() => !document.querySelector("#cloud").hidden);
  await page.waitForTimeout(500);
  const shot = () => page.locator("#cloud").screenshot();
  const before = await shot();
  await page.focus("#cloud");
  for (let i = 0; i < 5; i++) await page.keyboard.press("ArrowLeft");
  assert.ok(!before.equals(await shot()));
  await page.selectOption('[name="layout"]', "divider");
});

test("the page gives the command's result, with WebAssembly and with WebGPU", { timeout: 300_000 }, async () => {
  await writeFile(join(folder, "in.png"), await file("png"));
  const camera = "131.25,131.25,79.5,59.5";
  execFileSync(command, ["smooth", join(folder, "in.png"), join(folder, "out.pcd"), "--camera", camera, "--engine", "cpu"]);
  const expected = planish.open("out.pcd", await readFile(join(folder, "out.pcd")));
  const of = (frame) => planish.cloud(frame, "raw", "relief").points;
  for (const webgpu of [false, true]) {
    await open("in.png", await readFile(join(folder, "in.png")));
    await settled("in.png");
    if (webgpu) await change(() => page.check('[name="webgpu"]'));
    assert.match(await page.textContent("#status"), webgpu ? /WebGPU/ : /WebAssembly/);
    const [download] = await Promise.all([page.waitForEvent("download"), page.click('[data-format="pcd"]')]);
    assert.equal(download.suggestedFilename(), "in-smoothed.pcd");
    const saved = planish.open("saved.pcd", await readFile(await download.path()));
    const { largest, different } = compare(of(saved), of(expected));
    console.log(`${webgpu ? "WebGPU" : "WebAssembly"}: ${largest} m from the command at most`);
    assert.ok(largest < 6e-4 && different === 0, `${largest} ${different}`);
  }
});

/** Starts `planish view`, and returns the first line that it prints. */
async function view(t, ...parameters) {
  const viewer = spawn(command, ["view", ...parameters, "--page", `${root}/dist-page`, "--no-browser"], { stdio: ["ignore", "pipe", "inherit"] });
  t.after(() => viewer.kill("SIGKILL"));
  const [first] = await once(viewer.stdout, "data");
  return { viewer, address: String(first).split("\n")[0] };
}

test("`planish view` shows files that the page cannot read, passes the camera, and ends on Ctrl-C", { timeout: 120_000 }, async (t) => {
  const laz = join(folder, "a scan #1.laz");
  execFileSync(command, ["demo", "--out", join(folder, "demo")], { stdio: "ignore" });
  execFileSync(command, ["convert", join(folder, "demo", "raw.pcd"), laz], { stdio: "ignore" });
  const png = join(folder, "depth.png");
  execFileSync(command, ["convert", join(folder, "demo", "raw.pcd"), png], { stdio: "ignore" });
  for (const [file, parameters, said] of [[laz, [], /a scan #1\.pcd \(PCD\): [\d,]+ points/], [png, ["--camera", "600,601,319.5,239.5"], /depth\.png .*640x480/]]) {
    const { viewer, address } = await view(t, file, ...parameters);
    const shown = await browser.newPage();
    shown.on("pageerror", (error) => errors.push(error.message));
    await shown.goto(address);
    const isDone = (camera) => {
      const says = document.querySelector("#status").textContent;
      const fx = document.querySelector('[name="fx"]').value;
      return says.includes("points") && !document.body.hasAttribute("aria-busy") && (!camera || fx === "600");
    };
    await shown.waitForFunction(isDone, parameters.length > 0, { timeout: 100_000 });
    assert.match(await shown.textContent("#status"), said);
    assert.equal(await shown.isVisible("#error"), false);
    await shown.close();
    // Requests without the token, which is new in each run, are rejected.
    const { origin, pathname } = new URL(address);
    assert.match(pathname, /^\/[0-9a-f]{32}\/$/);
    for (const path of ["/", "/index.html", `/${"0".repeat(32)}/`, `${pathname}../index.html`]) {
      assert.equal((await fetch(origin + path)).status, 404, path);
    }
    viewer.kill("SIGINT");
    const [code] = await once(viewer, "exit");
    assert.equal(code, 0);
  }
});

test("the page raised no errors", () => assert.deepEqual(errors, []));
