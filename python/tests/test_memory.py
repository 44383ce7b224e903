"""Other allocators, which are preloaded: memory is freed by who has allocated it."""
import importlib.util
import os
import pathlib
import subprocess
import sys

import pytest

ROOT = pathlib.Path(__file__).parent.parent.parent

# Gives each block a mark, and ends the process where a block without it is freed. What is not its own is freed nowhere.
ALLOCATOR = r"""
#include <errno.h>
#include <stdint.h>
#include <string.h>
#include <unistd.h>

void *__libc_malloc(size_t);
void __libc_free(void *);
static const uint64_t mark = 0x73686164206f7765;
struct head { uint64_t mark; void *block; size_t size; uint64_t unused; };

static void *marked(size_t align, size_t size) {
    char *block = __libc_malloc(size + align + sizeof(struct head));
    if (!block) return 0;
    uintptr_t at = ((uintptr_t)block + sizeof(struct head) + align - 1) / align * align;
    struct head *head = (struct head *)at - 1;
    head->mark = mark, head->block = block, head->size = size;
    return (void *)at;
}
static struct head *own(void *at) {
    struct head *head = (struct head *)at - 1;
    if (head->mark != mark) { write(2, "freed by another\n", 17); _exit(66); }
    return head;
}
void *malloc(size_t size) { return marked(32, size); }
void free(void *at) {
    if (!at) return;
    struct head *head = own(at);
    head->mark = 0;
    __libc_free(head->block);
}
void *calloc(size_t count, size_t size) {
    void *at = marked(32, count * size);
    return at ? memset(at, 0, count * size) : 0;
}
void *realloc(void *at, size_t size) {
    void *new = marked(32, size);
    if (at && new) { size_t old = own(at)->size; memcpy(new, at, old < size ? old : size); free(at); }
    return new;
}
void *memalign(size_t align, size_t size) { return marked(align < 32 ? 32 : align, size); }
void *aligned_alloc(size_t align, size_t size) { return memalign(align, size); }
int posix_memalign(void **to, size_t align, size_t size) { return (*to = memalign(align, size)) ? 0 : ENOMEM; }
size_t malloc_usable_size(void *at) { return at ? own(at)->size : 0; }
void *valloc(size_t size) { return memalign(4096, size); }
"""

USE = """
import numpy as np
from shadow_repose import Policy, VectorEnv, evaluate
policy = Policy.load("policy.safetensors")
envs = VectorEnv(8, policy=policy, threads=2, training=True)
observations, _ = envs.reset()
for _ in range(20):
    observations, *_ = envs.step(policy(observations))
evaluate(policy, episodes=2, set={"env.max_episode_seconds": 0.1}, trace="x.jsonl", threads=2)
try:
    VectorEnv(1, set={"env.model": "nowhere.xml"})
except ValueError:
    print("done")
"""


def run(code, place, preloaded):
    target = place / "policy.safetensors"
    target.exists() or target.symlink_to(ROOT / "assets/policies/robust.safetensors")
    path = {"PYTHONPATH": os.pathsep.join(sys.path), "LD_PRELOAD": str(preloaded), "ASAN_OPTIONS": "detect_leaks=0"}
    return subprocess.run([sys.executable, "-c", code], cwd=place, env={**os.environ, **path}, capture_output=True, text=True)


@pytest.fixture(scope="module")
def allocator(tmp_path_factory):
    place = tmp_path_factory.mktemp("allocator")
    (place / "a.c").write_text(ALLOCATOR)
    try:
        subprocess.run(["cc", "-O1", "-shared", "-fPIC", "-fno-builtin", "-o", place / "a.so", place / "a.c"], check=True)
    except FileNotFoundError:
        pytest.skip("there is no compiler for an allocator")
    return place / "a.so"


def test_the_module_frees_with_a_preloaded_allocator_what_it_has_allocated(tmp_path, allocator):
    found = run(USE, tmp_path, allocator)
    assert (found.stdout, found.stderr, found.returncode) == ("done\n", "", 0)


def test_the_module_works_in_the_address_sanitizer(tmp_path):
    named = subprocess.run(["sh", "-c", "gcc -print-file-name=libasan.so"], capture_output=True, text=True).stdout.strip()
    if not os.path.isabs(named):
        pytest.skip("there is no address sanitizer")
    found = run(USE, tmp_path, named)
    assert (found.stdout, found.returncode) == ("done\n", 0), found.stderr


def test_what_the_module_cannot_bear_is_said_at_import(tmp_path, allocator):
    if not importlib.util.find_spec("mujoco"):
        pytest.skip("there is no mujoco to load beside ours")
    theirs = next(pathlib.Path(importlib.util.find_spec("mujoco").origin).parent.glob("libmujoco.so.*"))
    load = f"import ctypes; ctypes.CDLL({str(theirs)!r}, ctypes.RTLD_GLOBAL)\n"
    refused = run(f"{load}import shadow_repose", tmp_path, allocator)
    assert refused.returncode == 1 and "ImportError: the symbols of another MuJoCo are global" in refused.stderr
    first = run(f"import shadow_repose\n{load}{USE}", tmp_path, allocator)
    assert (first.stdout, first.returncode) == ("done\n", 0), first.stderr
