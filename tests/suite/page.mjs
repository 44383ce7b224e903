// Reads JSON from stdin: the blocks of a page, and poses of its bodies in some of its rows. Compares them with what the page's own
// code makes of the blocks.
import assert from "node:assert";
import fs from "node:fs";
import vm from "node:vm";

const { code, meta, scene, rows, meshes, poses } = JSON.parse(fs.readFileSync(0, "utf8"));
const page = vm.runInThisContext(`${code}\n;({ unpack, kinematics, Recording, quaternionPlaces, readMeshes })`);
const { bodies, meshes: lists } = JSON.parse(new TextDecoder().decode(await page.unpack(scene)));
const recording = await page.Recording.read(meta, rows);
const mixed = new Float32Array(recording.width), found = new Float32Array(8 * bodies.length);
let far = 0, turned = 0;
for (const { row, expected } of poses) {
  recording.mix(row, page.quaternionPlaces(bodies), mixed);
  page.kinematics(bodies, mixed, found);
  assert.equal(expected.length, bodies.length);
  expected.forEach((pose, body) => {
    far = Math.max(far, Math.hypot(...[0, 1, 2].map((i) => pose[i] - found[8 * body + i])));
    const same = Math.abs([0, 1, 2, 3].reduce((sum, i) => sum + pose[3 + i] * found[8 * body + 4 + i], 0));
    turned = Math.max(turned, 2 * Math.acos(Math.min(1, same)));
  });
}
if (lists.length) {
  const read = page.readMeshes(lists, await page.unpack(meshes));
  assert.equal(read.length, lists.length);
}

// What a live page saves is read again as it was.
const { text, entries } = await recording.write(), again = await page.Recording.read({ ...meta, ...entries }, text);
assert.equal(again.rows.length, recording.rows.length);
recording.rows.forEach((row, r) => row.forEach((value, i) => assert(Math.abs(value - again.rows[r][i]) <= .51 * entries.scale[i])));
recording.rows.at(-1)[recording.place.step] = 32768;
await assert.rejects(recording.write(), /more than 32767 steps/, "a counter that the file cannot hold");
console.log(JSON.stringify({ far, turned, episodes: recording.episodes[0].length }));
