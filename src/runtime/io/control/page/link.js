// The WebSocket: frames and states in, commands out. It comes back by itself.

const HEAD_BYTES = 16;
const VERSION = 1;
const KINDS = { 1: "line", 2: "fan", 3: "elements", 4: "scope", 5: "relief", 6: "soundings" };
export const STEP_DB = 0.5;

/** A binary frame taken apart; null where it is not one. */
export function decode(buffer) {
  if (buffer.byteLength < HEAD_BYTES) return null;
  const view = new DataView(buffer);
  const textBytes = view.getUint32(8, true);
  const arrayBytes = view.getUint32(12, true);
  const kind = KINDS[view.getUint8(0)];
  if (!kind || view.getUint8(1) !== VERSION || HEAD_BYTES + textBytes + arrayBytes !== buffer.byteLength) return null;
  const text = new TextDecoder().decode(new Uint8Array(buffer, HEAD_BYTES, textBytes));
  return {
    ...JSON.parse(text),
    kind,
    sonar: view.getUint16(2, true),
    ping: view.getUint32(4, true),
    levels: new Uint8Array(buffer, HEAD_BYTES + textBytes, arrayBytes),
    floats: arrayBytes % 4 === 0 ? new Float32Array(buffer, HEAD_BYTES + textBytes, arrayBytes / 4) : null,
  };
}

export class Link extends EventTarget {
  #socket = null;
  #waiting = new Map();
  #next = 1;
  #pause = 250;

  get isOpen() {
    return this.#socket?.readyState === WebSocket.OPEN;
  }

  open() {
    const url = new URL("page/socket", document.baseURI);
    url.protocol = url.protocol === "https:" ? "wss:" : "ws:";
    const protocols = ["echotank"];
    const token = sessionStorage.getItem("token");
    if (token) protocols.push(`token.${hex(token)}`);
    const socket = new WebSocket(url, protocols);
    socket.binaryType = "arraybuffer";
    this.#socket = socket;
    let opened = false;
    socket.onopen = () => {
      opened = true;
      this.#pause = 250;
      this.#tell("open");
    };
    socket.onmessage = (event) => this.#take(event.data);
    socket.onclose = () => {
      for (const answer of this.#waiting.values()) answer({ accepted: false, why: "the connection was lost" });
      this.#waiting.clear();
      this.#tell("closed");
      if (!opened) this.#whyNot();
      setTimeout(() => this.open(), this.#pause);
      this.#pause = Math.min(4000, this.#pause * 1.6);
    };
  }

  send(message) {
    if (this.isOpen) this.#socket.send(JSON.stringify(message));
  }

  /** What became of a command. */
  command(command) {
    return new Promise((answer) => {
      if (!this.isOpen) return answer({ accepted: false, why: "not connected" });
      const id = this.#next++;
      this.#waiting.set(id, answer);
      this.send({ command: { id, command } });
    });
  }

  #take(data) {
    if (data instanceof ArrayBuffer) {
      const frame = decode(data);
      if (frame) this.#tell(frame.kind, frame);
      return;
    }
    const message = JSON.parse(data);
    if ("id" in message) {
      this.#waiting.get(message.id)?.(message.answer);
      this.#waiting.delete(message.id);
      return;
    }
    for (const [name, value] of Object.entries(message)) this.#tell(name, value);
  }

  /** A browser does not say why a socket was refused; a plain request does. */
  async #whyNot() {
    try {
      const token = sessionStorage.getItem("token");
      const headers = token ? { Authorization: `Bearer ${token}` } : {};
      const reply = await fetch("status", { headers });
      if (reply.status === 401) this.#tell("token");
    } catch {
      // The daemon is not there.
    }
  }

  #tell(name, detail = null) {
    this.dispatchEvent(new CustomEvent(name, { detail }));
  }

  on(name, take) {
    this.addEventListener(name, (event) => take(event.detail));
  }
}

function hex(text) {
  return [...new TextEncoder().encode(text)].map((b) => b.toString(16).padStart(2, "0")).join("");
}
