// The worker that runs a reader's answers: Pyodide, from bytes that the page sends, and judge.py.
// It is a classic worker made of a blob, the one kind that both browsers start on a page from disk; Pyodide looks for importScripts
// to refuse those, and works in them.
self.importScripts = () => { throw new Error("not here"); };
let ask;

async function boot({wasm, factory, loader, library, lock, sources, page}) {
  const url = (text) => URL.createObjectURL(new Blob([text], {type: "text/javascript"}));
  self.fetch = async (asked) => {
    if (String(asked).endsWith("python_stdlib.zip")) return new Response(library);
    if (String(asked).endsWith(".wasm")) return new Response(new Uint8Array(), {headers: {"Content-Type": "application/wasm"}});
    throw new TypeError(`There is no network here: ${asked}`);
  };
  WebAssembly.instantiateStreaming = async (_, imports) => ({module: wasm, instance: await WebAssembly.instantiate(wasm, imports)});
  const [{default: createPyodideModule}, {loadPyodide}] = await Promise.all([import(url(factory)), import(url(loader))]);
  const python = await loadPyodide({
    createPyodideModule,
    lockFileContents: JSON.parse(lock),
    packageBaseUrl: "https://nowhere.invalid/",
    indexURL: "https://nowhere.invalid/",
  });
  python.unpackArchive(sources, "zip", {extractDir: "/practice"});
  ask = python.runPython(`
import json, sys
sys.path.insert(0, "/practice")
import judge
judge.open_page(${JSON.stringify(page)})
lambda task, given: json.dumps(getattr(judge, task)(*json.loads(given)))
`);
}

// "boot", with what boot takes, and then "check" and "draw", with what judge.py's functions of that name take.
self.onmessage = async ({data: {id, task, given}}) => {
  try {
    self.postMessage({id, value: (await (task === "boot" ? boot(given) : JSON.parse(ask(task, JSON.stringify(given))))) ?? null});
  } catch (error) {
    self.postMessage({id, error: String(error.message ?? error)});
  }
};
