// Browsers refuse workers on pages that were opened from disk: there the script of a worker, which the search has, runs in
// a frame of its own.
if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(url) {
      super();
      const frame = document.createElement("iframe");
      frame.hidden = true;
      document.body.append(frame);
      const inner = frame.contentWindow;
      inner.document.open();
      inner.document.write(
        "<script>postMessage = (data) => parent.postMessage(data, '*');" +
          "importScripts = (...urls) => urls.forEach((one) => document.write('<script src=\"' + one + '\"><\\/script>'));<\/script>" +
          `<script src="${url}"><\/script>`,
      );
      inner.document.close();
      this.ready = new Promise((done) => frame.addEventListener("load", () => done(inner)));
      addEventListener("message", (event) => {
        if (event.source !== inner) return;
        const told = new MessageEvent("message", { data: event.data });
        this.dispatchEvent(told);
        this.onmessage?.(told);
      });
    }
    postMessage(data) {
      this.ready.then((inner) => inner.dispatchEvent(new MessageEvent("message", { data })));
    }
    terminate() {}
  };
}
