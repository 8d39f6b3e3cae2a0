// Runs planish in a worker, so that the page stays responsive while a frame is smoothed.

import { Planish } from "../src/index";
import type { Call, Reply } from "./calls";

const wasm = new URL("../wasm/planish.wasm", import.meta.url);
const loading = Planish.load({ wasm });

async function answer(call: Call): Promise<unknown> {
  const engine = await loading;
  switch (call.method) {
    case "about":
      return { ...engine.about(), adapter: engine.adapter, withoutGpu: engine.withoutGpu, isSoftware: engine.isSoftware };
    case "open":
      return engine.open(call.name, new Uint8Array(call.bytes));
    case "simulate":
      return engine.simulate(call.seed);
    case "readCamera":
      return engine.readCamera(call.frame, call.text);
    case "smooth":
      engine.usesGpu = call.webgpu;
      return engine.smoothFrame(call.frame, call.settings, call.camera);
    case "picture":
      return engine.picture(call.frame, call.side, call.kind, call.camera);
    case "cloud":
      return engine.cloud(call.frame, call.side, call.kind, call.camera);
    case "write":
      return engine.write(call.result, call.format, call.camera);
    case "readSettings":
      return engine.readSettings(call.text);
    case "writeSettings":
      return engine.writeSettings(call.settings);
    case "release":
      return engine.release(...call.held);
  }
}

// Calls are answered in order.
let last: Promise<void> = Promise.resolve();
self.onmessage = ({ data: { id, call } }: MessageEvent<{ id: number; call: Call }>) => {
  last = last.then(async () => {
    let reply: Reply;
    try {
      reply = { id, value: await answer(call) };
    } catch (error) {
      reply = { id, error: error instanceof Error ? error.message : String(error) };
    }
    self.postMessage(reply);
  });
};
