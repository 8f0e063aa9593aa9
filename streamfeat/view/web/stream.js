// The stream: Foxglove's WebSocket protocol, as far as looking on needs it.

const PROTOCOLS = ["foxglove.sdk.v1", "foxglove.websocket.v1"];
const MESSAGE_DATA = 1;
const AGAIN_MS = 1000;
const SOON_MS = 50;

/** Calls `onChannels(channels)`, `onMessage(channel, message)`, `onOpen()` and `onClose()`. */
class Stream {
  constructor(port, listener) {
    this.url = `ws://${location.hostname || "127.0.0.1"}:${port}`;
    this.listener = listener;
    this.connect();
  }

  connect() {
    this.channels = new Map();
    this.wanted = new Map();
    this.next = 1;
    this.socket = new WebSocket(this.url, PROTOCOLS);
    this.socket.binaryType = "arraybuffer";
    this.socket.onopen = () => this.listener.onOpen();
    this.socket.onclose = () => {
      this.listener.onClose();
      setTimeout(() => this.connect(), AGAIN_MS);
    };
    this.socket.onmessage = ({ data }) => (typeof data === "string" ? this.told(data) : this.given(data));
  }

  /** Get the messages of these channels, and of no others. */
  subscribe(channels) {
    const ids = new Set(channels.map((channel) => channel.id));
    const gone = [...this.wanted].filter(([, id]) => !ids.has(id)).map(([subscription]) => subscription);
    gone.forEach((subscription) => this.wanted.delete(subscription));
    if (gone.length) this.send({ op: "unsubscribe", subscriptionIds: gone });
    const known = new Set(this.wanted.values());
    const added = [...ids].filter((id) => !known.has(id)).map((channelId) => ({ id: this.next++, channelId }));
    added.forEach(({ id, channelId }) => this.wanted.set(id, channelId));
    if (added.length) this.send({ op: "subscribe", subscriptions: added });
  }

  send(message) {
    this.socket.send(JSON.stringify(message));
  }

  told(text) {
    const message = JSON.parse(text);
    if (message.op === "advertise") message.channels.forEach((channel) => this.channels.set(channel.id, channel));
    else if (message.op === "unadvertise") message.channelIds.forEach((id) => this.channels.delete(id));
    else {
      if (message.op === "status") this.refused(message.message);
      return;
    }
    this.listener.onChannels([...this.channels.values()]);
  }

  /** The server tells of a channel a moment before it knows it itself: who subscribes at once may be refused. */
  refused(text) {
    const refusedId = Number(/^Unknown channel ID: (\d+)/.exec(text)?.[1]);
    for (const [id, channelId] of this.wanted) {
      if (channelId !== refusedId || !this.channels.has(channelId)) continue;
      const again = () => this.wanted.get(id) === channelId && this.send({ op: "subscribe", subscriptions: [{ id, channelId }] });
      setTimeout(again, SOON_MS);
    }
  }

  given(buffer) {
    const view = new DataView(buffer);
    if (view.getUint8(0) !== MESSAGE_DATA) return;
    const channel = this.channels.get(this.wanted.get(view.getUint32(1, true)));
    if (!channel) return;
    const bytes = new Uint8Array(buffer, 13);
    const message = channel.encoding === "json" ? JSON.parse(new TextDecoder().decode(bytes)) : rawImage(bytes);
    this.listener.onMessage(channel, message);
  }
}

/** A foxglove.RawImage in protobuf: `{width, height, data}`. */
function rawImage(bytes) {
  const image = { width: 0, height: 0, data: new Uint8Array() };
  const view = new DataView(bytes.buffer, bytes.byteOffset, bytes.length);
  let at = 0;
  const varint = () => {
    let value = 0;
    for (let shift = 1; ; shift *= 128) {
      const byte = bytes[at++];
      value += (byte & 127) * shift;
      if (byte < 128) return value;
    }
  };
  while (at < bytes.length) {
    const tag = varint();
    const field = tag >> 3;
    if ((tag & 7) === 5) {
      if (field === 2) image.width = view.getUint32(at, true);
      if (field === 3) image.height = view.getUint32(at, true);
      at += 4;
    } else if ((tag & 7) === 2) {
      const length = varint();
      if (field === 6) image.data = bytes.subarray(at, at + length);
      at += length;
    } else varint();
  }
  return image;
}
