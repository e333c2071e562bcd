// Lets the search work where the site is opened as a file: browsers refuse workers there.
// The script of the worker runs in a hidden frame instead. Material's search knows the name
// IFrameWorker, and then finds its files beside the script.
class IFrameWorker extends EventTarget {
  constructor(url) {
    super();
    this.frame = document.createElement("iframe");
    this.frame.hidden = true;
    this.ready = new Promise((resolve) => (this.frame.onload = resolve));
    document.body.append(this.frame);
    const page = this.frame.contentWindow;
    page.document.open();
    page.postMessage = (data) => this.answer(data);
    page.importScripts = (...urls) =>
      urls.reduce((before, one) => before.then(() => load(page.document, one)), Promise.resolve());
    page.document.write(`<body><script src="${url}"></script></body>`);
    page.document.close();
  }

  answer(data) {
    const event = new MessageEvent("message", { data });
    this.dispatchEvent(event);
    if (this.onmessage) this.onmessage(event);
  }

  postMessage(data) {
    const page = this.frame.contentWindow;
    this.ready.then(() => page.dispatchEvent(new page.MessageEvent("message", { data })));
  }

  terminate() {
    this.frame.remove();
  }
}

function load(document, url) {
  return new Promise((resolve, reject) => {
    const script = document.createElement("script");
    script.onload = resolve;
    script.onerror = reject;
    script.src = url;
    document.body.append(script);
  });
}

if (location.protocol === "file:") {
  window.IFrameWorker = IFrameWorker;
  window.Worker = IFrameWorker;
}
