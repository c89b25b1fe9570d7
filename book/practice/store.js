// What a reader has written and passed, in the browser's storage, for each edition of the book; without storage, as long as the page is open.
const ROOT = "course-practice";

export class Store {
  #prefix;
  #places = new Map(); // where there is no storage
  kept = true;

  constructor(version) {
    this.#prefix = `${ROOT}/${version}/`;
    try {
      localStorage.setItem(`${ROOT}/trial`, "");
      localStorage.removeItem(`${ROOT}/trial`);
    } catch {
      this.kept = false;
    }
  }

  #get(key) {
    return this.kept ? localStorage.getItem(key) : this.#places.get(key) ?? null;
  }

  #set(key, value) {
    try {
      if (this.kept && value === null) localStorage.removeItem(key);
      else if (this.kept) localStorage.setItem(key, value);
    } catch {
      this.kept = false; // it is full, or was switched off
    }
    if (value === null) this.#places.delete(key);
    else this.#places.set(key, value);
  }

  #keys() {
    return this.kept ? Object.keys(localStorage) : [...this.#places.keys()];
  }

  // An answer's draft; of another edition if this one has none; null if there is none at all.
  draft(name) {
    const own = this.#get(`${this.#prefix}draft/${name}`);
    if (own !== null) return own;
    const other = this.#keys().find((key) => key.startsWith(`${ROOT}/`) && key.endsWith(`/draft/${name}`));
    return other ? this.#get(other) : null;
  }

  keep(name, text) {
    this.#set(`${this.#prefix}draft/${name}`, text);
  }

  // The stub is as good as no draft, and other editions' drafts go with it.
  forget(name) {
    this.#keys().filter((key) => key.startsWith(`${ROOT}/`) && key.endsWith(`/draft/${name}`)).forEach((key) => this.#set(key, null));
  }

  passed(name) {
    return this.#get(`${this.#prefix}passed/${name}`) !== null;
  }

  pass(name) {
    this.#set(`${this.#prefix}passed/${name}`, new Date().toISOString());
  }

  // All of it, for a file.
  everything(names) {
    const drafts = Object.fromEntries(names.map((name) => [name, this.draft(name)]).filter(([, text]) => text !== null));
    return {kind: ROOT, drafts, passed: names.filter((name) => this.passed(name))};
  }
}

// What a file holds that `everything` was written to. Throws if it is none.
export function read(text, names) {
  const {kind, drafts = {}, passed = []} = JSON.parse(text);
  if (kind !== ROOT || !Array.isArray(passed)) throw new Error("not a file with drafts");
  return {
    drafts: Object.entries(drafts).filter(([name, draft]) => names.includes(name) && typeof draft === "string"),
    passed: passed.filter((name) => names.includes(name)),
  };
}
