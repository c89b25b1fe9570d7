// Python for the page: loaded when the first answer is checked, and run in a worker, so that an endless loop ends with its worker.
import workerText from "./worker.js" with {type: "text"};

export const LIMIT = 10_000; // milliseconds for one answer
const PARTS = ["wasm", "factory", "loader", "library", "lock", "sources"];
const folder = new URL("practice/", document.currentScript.src);
const arrived = new Map();

// Data lies in scripts beside this one, as pages from disk may load nothing else: each calls this with gzipped bytes in base64.
export const data = (name, text) => arrived.set(name, text);

export function script(name) {
  return new Promise((resolve, reject) => {
    const element = document.createElement("script");
    element.src = new URL(`${name}.js`, folder);
    element.onload = () => (element.remove(), resolve());
    element.onerror = () => reject(new Error(`${element.src} is missing`));
    document.head.append(element);
  });
}

export async function bytes(name) {
  await script(name);
  const packed = Uint8Array.fromBase64?.(arrived.get(name)) ?? Uint8Array.from(atob(arrived.get(name)), (one) => one.charCodeAt(0));
  arrived.delete(name);
  return new Uint8Array(await new Response(new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"))).arrayBuffer());
}

// What a worker is sent: Pyodide, our modules, and the chapter's cases; once, so that a worker after a stopped one starts in no time.
let parts;
function loaded(chapter) {
  parts ??= Promise.all([...PARTS, chapter].map(bytes)).then(async (all) => {
    const [wasm, factory, loader, library, lock, sources, page] = all;
    const [packages, handed] = [lock, page].map((text) => new TextDecoder().decode(text));
    return {wasm: await WebAssembly.compile(wasm), factory, loader, library, lock: packages, sources, page: handed};
  });
  parts.catch(() => { parts = undefined; });
  return parts;
}

class Engine {
  #worker = new Worker(URL.createObjectURL(new Blob([workerText], {type: "text/javascript"})));
  #waiting = new Map();
  #asked = 0;
  #ended; // why, once it has

  constructor(chapter) {
    this.chapter = chapter;
    this.#worker.onmessage = ({data: {id, value, error}}) => {
      const {resolve, reject} = this.#waiting.get(id);
      this.#waiting.delete(id);
      if (error === undefined) resolve(value);
      else reject(new Error(error));
    };
    this.#worker.onerror = (event) => this.end(new Error(event.message || "the worker failed"));
    this.#worker.onmessageerror = () => this.end(new Error("the worker got a message that it could not read"));
    this.ready = loaded(chapter).then((given) => this.ask("boot", given));
    this.ready.catch(() => {}); // whoever waits for it is told
  }

  ask(task, given) {
    return new Promise((resolve, reject) => {
      if (this.#ended) throw this.#ended;
      const id = ++this.#asked;
      this.#waiting.set(id, {resolve, reject});
      this.#worker.postMessage({id, task, given});
    });
  }

  end(reason) {
    this.#ended = reason;
    this.#worker.terminate();
    this.#waiting.forEach(({reject}) => reject(reason));
  }
}

let engine, started = false, asking = Promise.resolve();

// The verdict on an answer to one of the chapter's exercises; of several that are asked for, one after the other.
// `others` has the reader's answers to other exercises, which this one may call; `told` is called with a sentence while Python
// starts, and with "" when the answer runs.
export const check = (chapter, name, source, others = {}, told = () => {}) => ask(chapter, "check", [name, source, others], told);

// What a figure shows of the reader's answers: values, or a sentence that says why there are none. Likewise one after the other.
export async function draw(chapter, title, positions, answers, told = () => {}) {
  const {values, sentence, message} = await ask(chapter, "draw", [title, positions, answers], told);
  return {values, sentence: sentence ?? message, ended: message !== undefined};
}

function ask(chapter, task, given, told) {
  const answer = asking.then(() => one(chapter, task, given, told));
  asking = answer.catch(() => {});
  return answer;
}

async function one(chapter, task, given, told) {
  told(engine?.runs ? "" : started ? "Starting Python again …" : "Starting Python, once for this visit: it takes some seconds …");
  started = true;
  engine ??= new Engine(chapter);
  const own = engine;
  let clock;
  try {
    await own.ready;
    own.runs = true;
    told("");
    clock = setTimeout(() => stop(`It did not finish within ${LIMIT / 1000} seconds. Is there a loop that never ends?`), LIMIT);
    return await own.ask(task, given);
  } catch (error) {
    if (error instanceof Stopped) return {state: "timeout", misconceptions: [], message: error.message};
    if (engine === own) engine = undefined; // the next check tries anew
    own.end(error);
    if (own.runs) return {state: "error", misconceptions: [], message: `It ends Python itself: ${error.message.trim().split("\n").at(-1)}`};
    throw error;
  } finally {
    clearTimeout(clock);
  }
}

class Stopped extends Error {}

// Ends what runs now; another worker starts in the background.
export function stop(reason = "You stopped it.") {
  if (!engine) return;
  engine.end(new Stopped(reason));
  engine = new Engine(engine.chapter);
}
