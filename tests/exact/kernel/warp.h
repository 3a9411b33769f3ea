// A kernel's CUDA text on a CPU: each lane is a fiber that runs until it has to wait for others.
// A barrier that is missing shows: one lane then reads what another has not yet written, if lanes
// run upwards, or what another has already overwritten, if they run downwards.
#define __CUDACC__
#define ON_A_CPU
#define __device__
#define __global__
#define __shared__
#define __forceinline__ inline
#define __noinline__
#define __launch_bounds__(...)
#include <cmath>
#include <cstddef>
#include <cstdlib>
#include <cstring>
#include <functional>
#include <ucontext.h>
#include <vector>
#undef INFINITY
#undef NAN

static struct Place { int x; } threadIdx, blockIdx;
static float memory_of_block[1 << 20];
static inline float __int_as_float(int bits) { float x; std::memcpy(&x, &bits, 4); return x; }

struct Fiber {
  ucontext_t context;
  std::vector<char> stack = std::vector<char>(1 << 18);
  int waits = 0;  // for a warp (1), for those at barrier b (2 + b; 0: the block); -1: it is over
  float box;
};
static std::vector<Fiber> fibers;
static ucontext_t scheduler;
static std::function<void()> body;
static int running;

static void wait_for(int whom) {
  const int me = running;
  fibers[me].waits = whom;
  swapcontext(&fibers[me].context, &scheduler);
}
static void begin() { body(); fibers[running].waits = -1; swapcontext(&fibers[running].context, &scheduler); }
static void __syncwarp() { wait_for(1); }
static void __syncthreads() { wait_for(2); }
static void wait_at(int barrier, int) { wait_for(2 + barrier); }
template <class X> static X read_from(X x, int lane) {
  static_assert(sizeof(X) == 4);
  std::memcpy(&fibers[running].box, &x, 4);
  wait_for(1);
  X found;
  std::memcpy(&found, &fibers[running / 32 * 32 + lane].box, 4);
  wait_for(1);
  return found;
}
template <class X> static X __shfl_sync(unsigned, X x, int lane) { return read_from(x, lane); }
template <class X> static X __shfl_xor_sync(unsigned, X x, int bits) { return read_from(x, running % 32 ^ bits); }

// Runs a block; returns false if lanes wait for each other for ever.
static bool run_block(int block, int environments, int warps, bool downwards) {
  const int each = 32 * warps, n = each * environments;
  for (float& x : memory_of_block) x = __int_as_float(0x7fc00000);
  fibers = std::vector<Fiber>(n);
  for (Fiber& fiber : fibers) {
    getcontext(&fiber.context);
    fiber.context.uc_stack.ss_sp = fiber.stack.data();
    fiber.context.uc_stack.ss_size = fiber.stack.size();
    makecontext(&fiber.context, begin, 0);
  }
  for (int over = 0; over < n;) {
    bool moved = false;
    for (int k = 0; k < n; ++k) {
      running = downwards ? n - 1 - k : k;
      if (fibers[running].waits) continue;
      threadIdx.x = running; blockIdx.x = block;
      swapcontext(&scheduler, &fibers[running].context);
      over += fibers[running].waits == -1;
      moved = true;
    }
    auto all = [&](int from, int to, int what) {
      for (int k = from; k < to; ++k) if (fibers[k].waits != what) return false;
      return true;
    };
    auto release = [&](int from, int to) { for (int k = from; k < to; ++k) fibers[k].waits = 0; moved = true; };
    for (int w = 0; w < n; w += 32) if (all(w, w + 32, 1)) release(w, w + 32);
    for (int e = 0; e < environments; ++e)
      if (all(e * each, e * each + each, 3 + e)) release(e * each, e * each + each);
    if (all(0, n, 2)) release(0, n);
    if (!moved && over < n) return false;
  }
  return true;
}
