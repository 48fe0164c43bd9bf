// Corners placed by hand, with undo and redo.  A corner is {at: [u, v] (px), hand: bool}; missing ones are not placed.

export class Corners {
  #states = [new Map()];
  #now = 0;

  get current() { return this.#states[this.#now]; }
  get canUndo() { return this.#now > 0; }
  get canRedo() { return this.#now < this.#states.length - 1; }

  #commit(next) {
    this.#states.splice(this.#now + 1);
    this.#states.push(next);
    if (this.#states.length > 500) this.#states.shift();
    this.#now = this.#states.length - 1;
  }

  put(name, at, hand) {
    const next = new Map(this.current);
    next.set(name, { at: [...at], hand });
    this.#commit(next);
  }

  release(name) {
    const corner = this.current.get(name);
    if (!corner?.hand) return false;
    this.put(name, corner.at, false);
    return true;
  }

  take(name) {
    if (!this.current.has(name)) return false;
    const next = new Map(this.current);
    next.delete(name);
    this.#commit(next);
    return true;
  }

  clear() {
    if (!this.current.size) return false;
    this.#commit(new Map());
    return true;
  }

  undo() { if (!this.canUndo) return false; this.#now -= 1; return true; }
  redo() { if (!this.canRedo) return false; this.#now += 1; return true; }
}
