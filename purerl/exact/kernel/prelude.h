// The words of a kernel's text. CUDA: WARPS warps step an environment. They share a statement of
// many numbers (EACH, SEVERAL); statements of few, or of sums that lanes share, are a single warp's
// (ONE), and turn says whose. C++: one lane does all, and adds in the same order as the 32.
//
// No word asks lanes for a vote (__any_sync, __reduce_max_sync). On an H200 builds with votes both
// as a loop's condition and as a branch's gave wrong numbers, the same each time, and nobody found
// out why. Here every lane computes a condition from numbers that all of them read, and then takes
// what lane 0 has found.

#ifdef __CUDACC__

#define INFINITY __int_as_float(0x7f800000)
#define NAN __int_as_float(0x7fffffff)
#define INT_MAX 2147483647
#define INT_MIN (-INT_MAX - 1)
#define TABLE __device__ const
#define THREADS (32 * WARPS)  // of an environment
#define KERNEL extern "C" __global__ void __launch_bounds__(THREADS * ENVIRONMENTS, 1) kernel
#define FUNCTION static __device__ __forceinline__
#define ROUTINE static __device__ __noinline__
#define EACH(turn, i, n) \
  _Pragma("unroll 1") for (int i = first_of(thread, turn); i < (n); i += THREADS)
#define SEVERAL(turn, i, times, n) \
  _Pragma("unroll 1") for (int i = first_of(thread, turn); i < (n); i += times * THREADS)
#define AT(i, k, n) least(i + k * THREADS, n - 1)
#define FEW(turn, i, n) if (const int i = lane; i < (n) && IS(turn))
#define WARP(lanes)
#define ONE(turn) if (IS(turn))
#define IS(turn) (WARPS == 1 || thread / 32 == (turn) % WARPS)
#define LANES(i, first, end) \
  _Pragma("unroll 1") for (int i = (first) + ((lane - (first)) & 31); i < (end); i += 32)
#define ROUNDS(j, n) _Pragma("unroll 32") for (int j = 0; j < (n); ++j)  // loads before sums
#define REPEAT(j, n) for (int j = 0, end = unknown(n); j < end; ++j)  // too long to be unrolled
#define SYNC together()
#define LOCKSTEP __syncthreads()
#define UNIFORM(x) uniform(x)
#define SUMS(type, n, start) type sums[n]; _Pragma("unroll") for (int k = 0; k < n; ++k) sums[k] = start;
#define SUM(k) sums[k]
#define PUT(join, n, used, memory, to) put<n, used>(sums, memory, to, lane, join());
#define NAMES \
  const int lane = threadIdx.x & 31; \
  int* const I = (int*)P; \
  const float* const C = (const float*)C_; \
  (void)lane; (void)I; (void)C;
#define BEGIN \
  const int thread = threadIdx.x % THREADS; \
  const int asked = blockIdx.x * ENVIRONMENTS + threadIdx.x / THREADS; \
  const bool there = asked < environments[0]; /* the last block's others keep step */ \
  const size_t e = there ? asked : environments[0] - 1; \
  extern __shared__ float memory_of_block[]; \
  float* const P = memory_of_block + (threadIdx.x / THREADS) * MEMORY; \
  NAMES
#define END

#ifndef ON_A_CPU
FUNCTION void wait_at(int barrier, int threads) {
  asm volatile("bar.sync %0, %1;" ::"r"(barrier), "r"(threads) : "memory");
}
#endif

// An environment's warps wait for each other. Barrier 0 is the block's, LOCKSTEP.
FUNCTION void together() {
  if (WARPS == 1) __syncwarp();
  else wait_at(1 + threadIdx.x / THREADS, THREADS);
}

// Hides a number from the compiler, which would unroll long loops whatever a pragma says.
FUNCTION int unknown(int x) {
  asm volatile("" : "+r"(x));
  return x;
}

// Where a thread begins if the warps take turns from one that is not the first.
FUNCTION int first_of(int thread, int turn) {
  const int i = thread + 32 * (turn % WARPS);
  return i < THREADS ? i : i - THREADS;
}

FUNCTION int uniform(int x) {
  int first = __shfl_sync(~0u, x, 0);
  together();  // all have read before anything is written that the condition was made of
  return first;
}

#else

#include <climits>
#include <cmath>
#include <cstddef>
#include <cstdlib>
#define TABLE static const
#define KERNEL extern "C" void kernel
#define FUNCTION static inline
#define ROUTINE static
#define EACH(turn, i, n) ROUNDS(i, n)
#define SEVERAL(turn, i, times, n) for (int i = 0; i < (n); i += times)
#define AT(i, k, n) least(i + k, n - 1)
#define FEW EACH
#define WARP(lanes) ROUNDS(lane, lanes)
#define ONE(turn)
#define LANES(i, first, end) for (int i = (first); i < (end); ++i)
#define ROUNDS(j, n) for (int j = 0; j < (n); ++j)
#define REPEAT ROUNDS
#define SYNC
#define LOCKSTEP
#define UNIFORM(x) (x)
#define SUMS(type, n, start) type sums[n][32]; for (auto& row : sums) for (auto& x : row) x = start;
#define SUM(k) sums[k][i & 31]
#define PUT(join, n, used, memory, to) put<used>(sums, memory, to, join());
#define NAMES \
  const int lane = 0; \
  int* const I = (int*)P; \
  const float* const C = (const float*)C_; \
  (void)lane; (void)I; (void)C;
#define BEGIN \
  const int thread = 0; \
  const bool there = true; \
  static thread_local float P[MEMORY]; \
  NAMES \
  for (size_t e = 0; e < (size_t)environments[0]; ++e) { \
    for (float& x : P) x = NAN;  // what is read before it is written shows
#define END }

#endif

#define PART(name) ROUTINE void name(float* const P, const int thread) { NAMES

FUNCTION float most(float a, float b) { return (a > b || a != a) ? a : b; }  // NaN before any number
FUNCTION float least(float a, float b) { return (a < b || a != a) ? a : b; }
FUNCTION int most(int a, int b) { return a > b ? a : b; }
FUNCTION int least(int a, int b) { return a < b ? a : b; }
FUNCTION float sign_of(float x) { return x > 0 ? 1.0f : x < 0 ? -1.0f : x; }
FUNCTION int sign_of(int x) { return (x > 0) - (x < 0); }
FUNCTION float rest_of(float x, float y) { return fmodf(x, y); }
FUNCTION int rest_of(int x, int y) { return y == 0 ? x : y == -1 ? 0 : x % y; }
FUNCTION int is_finite(float x) { return fabsf(x) < INFINITY; }

#define JOINED_BY(name, text) \
  struct joined_by_##name { \
    template <class X> FUNCTION_OF_STRUCT X operator()(X a, X b) const { return text; } \
  };
#ifdef __CUDACC__
#define FUNCTION_OF_STRUCT __device__ __forceinline__
#else
#define FUNCTION_OF_STRUCT
#endif
JOINED_BY(add, a + b)
JOINED_BY(mul, a * b)
JOINED_BY(max, most(a, b))
JOINED_BY(min, least(a, b))
JOINED_BY(and, a & b)
JOINED_BY(or, a | b)

#ifdef __CUDACC__

// Joins what the lanes have of n sums: with lane l ^ 16 first, then l ^ 8, ... A step with more sums
// than its distance halves them: one lane of a pair goes on with each. In the end lane l has sum l.
template <int n, int far, class X, class Join>
FUNCTION void joined(X* sums, int lane, Join join) {
  if constexpr (n > far) {
    const bool upper = lane & far;
#pragma unroll
    for (int k = 0; k < far; ++k) {
      const X given = upper ? sums[k] : sums[k + far], kept = upper ? sums[k + far] : sums[k];
      sums[k] = join(kept, __shfl_xor_sync(~0u, given, far));
    }
  } else {
#pragma unroll
    for (int k = 0; k < n; ++k) sums[k] = join(sums[k], __shfl_xor_sync(~0u, sums[k], far));
  }
  if constexpr (far > 1) joined<(n > far ? far : n), far / 2>(sums, lane, join);
}
template <int n, int used, class X, class Join>
FUNCTION void put(X* sums, X* memory, const unsigned short* to, int lane, Join join) {
#pragma unroll
  for (int first = 0; first < n; first += 32) {
    joined<(n < 32 ? n : 32), 16>(sums + first, lane, join);
    if (lane < 32 && lane < used - first) memory[to[first + lane]] = sums[first];
  }
}

#else

template <int used, class X, class Join>
FUNCTION void put(X (*sums)[32], X* memory, const unsigned short* to, Join join) {
  for (int k = 0; k < used; ++k) {
    X* lanes = sums[k];
    for (int far = 16; far; far /= 2)
      for (int l = 0; l < far; ++l) lanes[l] = join(lanes[l], lanes[l + far]);
    memory[to[k]] = lanes[0];
  }
}

#endif

// Column by column: the pivot's root, the column, then what it takes from the columns to the right.
// A pivot that is not positive makes NaN of all that follows.
FUNCTION float pivot_of(float x) { return x > 0 ? sqrtf(x) : NAN; }

#ifdef __CUDACC__

// Up to 32 columns by the lanes of a warp, more by all threads of an environment.
template <int n>
ROUTINE void cholesky(float* A, int thread) {
  const int lane = threadIdx.x & 31;
  if constexpr (n <= 32) {  // a row in the registers of each lane
    const int r = lane < n ? lane : n - 1;
    float row[n];
#pragma unroll
    for (int c = 0; c < n; ++c) row[c] = A[r * n + c];
#pragma unroll
    for (int j = 0; j < n; ++j) {
      const float d = pivot_of(__shfl_sync(~0u, row[j], j));
      const float scaled = row[j] * (1.0f / d);
      row[j] = r == j ? d : scaled;
#pragma unroll
      for (int c = j + 1; c < n; ++c) row[c] -= row[j] * __shfl_sync(~0u, row[j], c);
    }
    __syncwarp();
    if (lane < n)
#pragma unroll
      for (int c = 0; c < n; ++c) A[r * n + c] = c <= r ? row[c] : 0.0f;
  } else {
    for (int j = 0; j < n; ++j) {
      const float d = pivot_of(A[j * n + j]);
      together();
      for (int r = j + thread; r < n; r += THREADS) A[r * n + j] = r == j ? d : A[r * n + j] * (1.0f / d);
      together();
      for (int r = j + 1 + thread / 32; r < n; r += WARPS)
        for (int c = j + 1 + lane; c <= r; c += 32) A[r * n + c] -= A[r * n + j] * A[c * n + j];
      together();
    }
    for (int k = thread; k < n * n; k += THREADS) if (k % n > k / n) A[k] = 0;
  }
}

// Each x that is found is taken from the equations still to solve. Entry (r, k) of the matrix is
// A[r * down + k * across].
template <int n, int down, int across, int forward>
ROUTINE void solve(const float* A, float* x, int lane) {
  constexpr int rows = (n + 31) / 32;
  float y[rows], per_pivot[rows];
#pragma unroll
  for (int t = 0; t < rows; ++t) {
    const int r = lane + 32 * t;
    y[t] = r < n ? x[r] : 0.0f;
    per_pivot[t] = r < n ? 1.0f / A[r * (down + across)] : 0.0f;
  }
#pragma unroll 32
  for (int q = 0; q < n; ++q) {
    const int k = forward ? q : n - 1 - q;
    float mine = 0;
#pragma unroll
    for (int t = 0; t < rows; ++t)
      if (k / 32 == t) {
        if (lane == k % 32) y[t] *= per_pivot[t];
        mine = y[t];
      }
    const float found = __shfl_sync(~0u, mine, k % 32);
#pragma unroll
    for (int t = 0; t < rows; ++t) {
      const int r = lane + 32 * t;
      if (r < n && (forward ? r > k : r < k)) y[t] -= A[r * down + k * across] * found;
    }
  }
#pragma unroll
  for (int t = 0; t < rows; ++t) if (lane + 32 * t < n) x[lane + 32 * t] = y[t];
}

#else

template <int n>
ROUTINE void cholesky(float* A, int) {
  for (int j = 0; j < n; ++j) {
    const float d = A[j * n + j] = pivot_of(A[j * n + j]);
    for (int r = j + 1; r < n; ++r) A[r * n + j] *= 1.0f / d;
    for (int r = j + 1; r < n; ++r)
      for (int c = j + 1; c <= r; ++c) A[r * n + c] -= A[r * n + j] * A[c * n + j];
    for (int c = j + 1; c < n; ++c) A[j * n + c] = 0;
  }
}

template <int n, int down, int across, int forward>
ROUTINE void solve(const float* A, float* x, int) {
  for (int q = 0; q < n; ++q) {
    const int k = forward ? q : n - 1 - q;
    x[k] *= 1.0f / A[k * (down + across)];
    for (int r = forward ? k + 1 : 0; r < (forward ? n : k); ++r)
      x[r] -= A[r * down + k * across] * x[k];
  }
}

#endif
