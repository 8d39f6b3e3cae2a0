// The WebAssembly module: requests as JSON with bytes, and replies in the same form
// (crates/planish-web/src/request.rs).

/** An error with a message for users. */
export class PlanishError extends Error {
  override name = "PlanishError";
}

interface Exports {
  memory: WebAssembly.Memory;
  planish_alloc(len: number): number;
  planish_free(at: number, len: number): void;
  planish_call(json: number, jsonLen: number, bytes: number, bytesLen: number): void;
  planish_reply(part: number): number;
  planish_reply_len(part: number): number;
  planish_reply_done(): void;
}

const NO_BYTES = new Uint8Array();

/** Memory in use, of 4096 MiB, above which a stopped module has most likely run out of memory. */
const NEARLY_FULL_MIB = 1024;

/** The module and its contents: numbered frames, plans and results. */
export class Core {
  private exports: Exports;
  /** The largest number assigned to a frame, plan or result. */
  private last = 0;

  private constructor(
    private readonly module: WebAssembly.Module,
    instance: WebAssembly.Instance,
  ) {
    this.exports = instance.exports as unknown as Exports;
  }

  /** Compiles the module from its bytes or a response. */
  static async load(source: Response | BufferSource): Promise<Core> {
    try {
      const { module, instance } =
        source instanceof Response
          ? await WebAssembly.instantiateStreaming(source, {})
          : await WebAssembly.instantiate(source, {});
      return new Core(module, instance);
    } catch (error) {
      throw new PlanishError(`planish.wasm cannot be loaded: ${String(error)}`, { cause: error });
    }
  }

  /** Sends a request and returns the reply. The bytes of the reply are a copy. */
  call<T>(request: { op: string; [key: string]: unknown }, bytes: Uint8Array = NO_BYTES): { ok: T; bytes: Uint8Array<ArrayBuffer> } {
    const text = written(request);
    let answer: { ok: T; bytes: Uint8Array<ArrayBuffer> };
    try {
      answer = this.ask<T>(new TextEncoder().encode(text), bytes);
    } catch (error) {
      if (!(error instanceof WebAssembly.RuntimeError)) throw error;
      const usedMiB = Math.round(this.memoryBytes / 2 ** 20);
      this.startAnew();
      const isFull = usedMiB > NEARLY_FULL_MIB;
      const why = isFull ? `out of memory, with ${usedMiB} MiB in use` : error.message;
      throw new PlanishError(
        `the WebAssembly module stopped (${why}) and was restarted; its frames and results are lost. Open the frame again${isFull ? ", or a smaller one" : ""}`,
      );
    }
    const { frame, plan, result } = (answer.ok ?? {}) as { frame?: number; plan?: number; result?: number };
    this.last = Math.max(this.last, frame ?? 0, plan ?? 0, result ?? 0);
    return answer;
  }

  private ask<T>(json: Uint8Array, bytes: Uint8Array): { ok: T; bytes: Uint8Array<ArrayBuffer> } {
    const e = this.exports;
    const jsonAt = this.put(json);
    let bytesAt: number;
    try {
      bytesAt = this.put(bytes);
    } catch (error) {
      e.planish_free(jsonAt, json.length);
      throw error;
    }
    e.planish_call(jsonAt, json.length, bytesAt, bytes.length);
    e.planish_free(jsonAt, json.length);
    e.planish_free(bytesAt, bytes.length);
    const reply = JSON.parse(new TextDecoder().decode(this.part(0))) as { ok?: T; error?: string };
    const answer = this.part(1).slice();
    e.planish_reply_done();
    if (reply.error !== undefined) throw new PlanishError(reply.error);
    return { ok: renamed(reply.ok, camelCase) as T, bytes: answer };
  }

  /** Starts a new instance after a trap, since the old one cannot be trusted. Numbers are never reused. */
  private startAnew(): void {
    this.exports = new WebAssembly.Instance(this.module, {}).exports as unknown as Exports;
    this.ask(new TextEncoder().encode(JSON.stringify({ op: "continue", after: this.last })), NO_BYTES);
  }

  /** Size of the module's memory in bytes. */
  get memoryBytes(): number {
    return this.exports.memory.buffer.byteLength;
  }

  private put(bytes: Uint8Array): number {
    // The module returns addresses as signed numbers.
    const at = this.exports.planish_alloc(bytes.length) >>> 0;
    if (at === 0) throw new PlanishError(`out of memory: the module has ${this.memoryBytes} bytes and needs ${bytes.length} more`);
    new Uint8Array(this.exports.memory.buffer, at, bytes.length).set(bytes);
    return at;
  }

  private part(part: number): Uint8Array<ArrayBuffer> {
    const { memory, planish_reply, planish_reply_len } = this.exports;
    return new Uint8Array(memory.buffer as ArrayBuffer, planish_reply(part) >>> 0, planish_reply_len(part) >>> 0);
  }
}

/** Converts a camelCase name of TypeScript to a snake_case name of the module. */
function snakeCase(name: string): string {
  return name.replace(/[A-Z]/g, (letter) => `_${letter.toLowerCase()}`);
}

function camelCase(name: string): string {
  return name.replace(/_([a-z])/g, (_, letter: string) => letter.toUpperCase());
}

/** Renames the keys of plain objects, at every depth. */
export function renamed(value: unknown, rename: (name: string) => string): unknown {
  if (Array.isArray(value)) return value.map((item) => renamed(item, rename));
  if (typeof value !== "object" || value === null) return value;
  return Object.fromEntries(Object.entries(value).map(([name, item]) => [rename(name), renamed(item, rename)]));
}

/** Serializes a request as JSON. Cycles, functions and big integers are errors. */
function written(request: object): string {
  try {
    return JSON.stringify(renamed(request, snakeCase), onlyFinite);
  } catch (error) {
    if (error instanceof PlanishError) throw error;
    throw new PlanishError(`the request cannot be written as JSON: ${String(error)}`, { cause: error });
  }
}

/** Rejects numbers that JSON cannot represent. */
function onlyFinite(key: string, value: unknown): unknown {
  if (typeof value === "number" && !Number.isFinite(value)) throw new PlanishError(`${key} = ${value} is not a finite number`);
  return value;
}
