// The stream: what the server shows, and what the page asks of it (see view/server.py).

const AGAIN_MS = 1000;

/** Calls `onMessage(camera, channel, message)`, `onOpen()` and `onClose()`. */
class Stream {
  constructor(port, token, listener) {
    this.url = `ws://${location.hostname || "127.0.0.1"}:${port}/stream?token=${encodeURIComponent(token)}`;
    this.listener = listener;
    this.connect();
  }

  connect() {
    this.socket = new WebSocket(this.url);
    this.socket.binaryType = "arraybuffer";
    this.socket.onopen = () => this.listener.onOpen();
    this.socket.onclose = () => {
      this.listener.onClose();
      setTimeout(() => this.connect(), AGAIN_MS);
    };
    this.socket.onmessage = ({ data }) => {
      if (typeof data === "string") {
        const { camera, channel, record } = JSON.parse(data);
        this.listener.onMessage(camera, channel, record);
        return;
      }
      const length = new DataView(data).getUint16(0, true);
      const { camera, channel, ...size } = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 2, length)));
      this.listener.onMessage(camera, channel, { ...size, data: new Uint8Array(data, 2 + length) });
    };
  }

  ask(op, values = {}) {
    if (this.socket.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify({ op, ...values }));
  }
}
