// What an answer to a step was like, as a bench test asks it. Times in s, values in the signal's unit.

const TAIL = 0.2; // of the step, its end, over which the last value is taken
const BAND = 0.05; // of the step, within which it is settled
const FEW = 10; // samples

// The figures of a step, of a command and what was measured; null: there was none that was answered.
export function figures(times, command, measured) {
  const known = times.map((t, i) => [t, command[i], measured[i]]).filter(([, wanted, got]) => wanted !== null && got !== null);
  if (known.length < FEW) return null;
  const [, before] = known[0], [, target] = known.at(-1);
  // Nothing was commanded before, or the same: it begins with the first command, where it was then.
  const begin = Math.max(0, known.findIndex(([, wanted]) => Math.abs(wanted - before) > 0.01 * Math.abs(target - before)));
  const [t0] = known[begin], start = known[Math.max(0, begin - 1)][2], answer = known.slice(begin);
  const tail = answer.slice(-Math.max(1, Math.round(TAIL * answer.length))).map(([, , got]) => got);
  const last = tail.reduce((sum, one) => sum + one, 0) / tail.length, size = last - start;
  if (!(Math.abs(size) > 0.02 * Math.abs(target - start))) return null; // it did not answer
  const share = got => (got - start) / size;
  const reached = part => answer.find(([, , got]) => share(got) >= part)[0];
  const outside = answer.findLastIndex(([, , got]) => Math.abs(share(got) - 1) > BAND);
  return {
    delay: reached(0.1) - t0,
    rise: reached(0.9) - reached(0.1),
    overshoot: Math.max(0, ...answer.map(([, , got]) => share(got) - 1)),
    settled: outside + 1 < answer.length ? answer[outside + 1][0] - t0 : null,
    error: target - last,
    noise: Math.sqrt(tail.reduce((sum, one) => sum + (one - last) ** 2, 0) / tail.length),
  };
}

export function inWords(found, unit) {
  if (!found) return "nothing that answers a step was measured";
  const { delay, rise, overshoot, settled, error, noise } = found;
  const ms = s => `${Math.round(1000 * s)} ms`;
  return `10 % after ${ms(delay)}, to 90 % in ${ms(rise)}, overshoot ${(100 * overshoot).toFixed(0)} %, ` +
    `${settled === null ? "not settled" : `within 5 % after ${ms(settled)}`}, error ${error.toPrecision(2)} ${unit}, noise ${noise.toPrecision(2)} ${unit}`;
}
