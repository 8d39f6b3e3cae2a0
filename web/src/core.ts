// The WebAssembly module: requests in JSON with bytes, replies likewise (crates/planish-web/src/request.rs).

/** What was wrong, in words. */
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

/** The module, and what it holds: frames, plans and results by their numbers. */
export class Core {
  private constructor(private readonly exports: Exports) {}

  /** Compiles the module from its bytes or a response. */
  static async load(source: Response | BufferSource): Promise<Core> {
    const { instance } =
      source instanceof Response
        ? await WebAssembly.instantiateStreaming(source, {})
        : await WebAssembly.instantiate(source, {});
    return new Core(instance.exports as unknown as Exports);
  }

  /** Asks for something. The bytes of the reply are a copy. */
  call<T>(request: { op: string; [key: string]: unknown }, bytes: Uint8Array = NO_BYTES): { ok: T; bytes: Uint8Array<ArrayBuffer> } {
    const json = new TextEncoder().encode(JSON.stringify(request));
    const e = this.exports;
    const [jsonAt, bytesAt] = [this.put(json), this.put(bytes)];
    try {
      e.planish_call(jsonAt, json.length, bytesAt, bytes.length);
    } finally {
      e.planish_free(jsonAt, json.length);
      e.planish_free(bytesAt, bytes.length);
    }
    const reply = JSON.parse(new TextDecoder().decode(this.part(0))) as { ok?: T; error?: string };
    const answer = this.part(1).slice();
    e.planish_reply_done();
    if (reply.error !== undefined) throw new PlanishError(reply.error);
    return { ok: reply.ok as T, bytes: answer };
  }

  /** Bytes of the module's memory. */
  get memoryBytes(): number {
    return this.exports.memory.buffer.byteLength;
  }

  private put(bytes: Uint8Array): number {
    const at = this.exports.planish_alloc(bytes.length);
    if (at === 0) throw new PlanishError(`out of memory: ${bytes.length} bytes`);
    new Uint8Array(this.exports.memory.buffer, at, bytes.length).set(bytes);
    return at;
  }

  private part(part: number): Uint8Array<ArrayBuffer> {
    const { memory, planish_reply, planish_reply_len } = this.exports;
    return new Uint8Array(memory.buffer as ArrayBuffer, planish_reply(part), planish_reply_len(part));
  }
}
