/* The rollout of one sample: semi-implicit Euler, springs by the offset of their ends.
 *
 * Compiled for one body: NUM_PARTICLES, HALO (the largest offset) and OFFSETS are macros, so that
 * the loops over offsets unroll. Positions and velocities are structures of arrays with HALO inert
 * particles at either end, twice: a step reads one copy and writes the other.
 */
#include <math.h>
#include <stdlib.h>
#include <string.h>
#ifdef __SSE__
#include <xmmintrin.h>
#endif

static const int offsets[] = {OFFSETS};
#define NUM_OFFSETS ((int)(sizeof(offsets) / sizeof(offsets[0])))
#define SPRINGS (HALO + NUM_PARTICLES)
/* Rows start on cache lines. */
#define ROW ((HALO + NUM_PARTICLES + HALO + 15) / 16 * 16)
#define UNROLL _Pragma("GCC unroll 64")
#define SIMD _Pragma("omp simd")

/* Force per distance of the ends, newtons per metre, of all springs; column i: from particle i. */
static void tensions(const float *restrict state, const float *restrict stiffness,
                     const float *restrict rest_force, const float *restrict damping,
                     float shortest, float *restrict tension) {
  const float *x = state, *y = x + ROW, *z = y + ROW, *u = z + ROW, *v = u + ROW, *w = v + ROW;
  const float floor = shortest * shortest;
  SIMD for (int i = 0; i < SPRINGS; i++) {
    const float xi = x[i], yi = y[i], zi = z[i], ui = u[i], vi = v[i], wi = w[i];
    UNROLL for (int d = 0; d < NUM_OFFSETS; d++) {
      const int j = i + offsets[d], s = d * SPRINGS + i;
      const float dx = x[j] - xi, dy = y[j] - yi, dz = z[j] - zi;
      const float rate = dx * (u[j] - ui) + dy * (v[j] - vi) + dz * (w[j] - wi);
      const float r = 1.0f / sqrtf(fmaxf(dx * dx + dy * dy + dz * dz, floor));
      tension[d * ROW + i] = stiffness[s] - r * (rest_force[s] - r * damping[s] * rate);
    }
  }
}

typedef struct {
  float radius, friction, drag, gravity, time_step, shortest;
} Physics;

/* Forces in registers, contact, and the new state. */
static void integrate(const float *restrict state, const float *restrict tension,
                      const float *restrict dt_over_mass, Physics physics, float *restrict next) {
  const float *x = state, *y = x + ROW, *z = y + ROW, *u = z + ROW, *v = u + ROW, *w = v + ROW;
  const float dt = physics.time_step, radius = physics.radius, friction = physics.friction;
  const float keep = 1.0f - dt * physics.drag, fall = dt * physics.gravity, rate = 1.0f / dt;
  SIMD for (int p = HALO; p < SPRINGS; p++) {
    const float xp = x[p], yp = y[p], zp = z[p], scale = dt_over_mass[p - HALO];
    float fx = 0, fy = 0, fz = 0;
    UNROLL for (int d = 0; d < NUM_OFFSETS; d++) {
      const int after = p + offsets[d], before = p - offsets[d];
      const float to = tension[d * ROW + p], from = tension[d * ROW + before];
      fx += to * (x[after] - xp) - from * (xp - x[before]);
      fy += to * (y[after] - yp) - from * (yp - y[before]);
      fz += to * (z[after] - zp) - from * (zp - z[before]);
    }
    const float vx = u[p] * keep + scale * fx, vy = v[p] * keep + scale * fy;
    const float vz = w[p] * keep + scale * fz - fall;
    const float normal = fmaxf(vz, (radius - zp) * rate);
    const float sliding = sqrtf(fmaxf(vx * vx + vy * vy, 1e-12f));
    const float kept = fmaxf(0.0f, 1.0f - friction * (normal - vz) / sliding);
    next[p] = xp + dt * vx * kept;
    next[p + ROW] = yp + dt * vy * kept;
    next[p + 2 * ROW] = zp + dt * normal;
    next[p + 3 * ROW] = vx * kept;
    next[p + 4 * ROW] = vy * kept;
    next[p + 5 * ROW] = normal;
  }
}

/* Particles carried by pickers move by a share of their displacement, whatever the forces. */
static void carry(const float *state, const int *pick, const float *displacement, int num_pickers,
                  float share, float dt, float *next) {
  for (int g = 0; g < num_pickers; g++)
    for (int axis = 0; axis < 3; axis++) {
      const int p = axis * ROW + HALO + pick[g];
      const float speed = displacement[3 * g + axis] * share / dt;
      next[p] = state[p] + dt * speed;
      next[p + 3 * ROW] = speed;
    }
}

/* Positions at first and at the end are (NUM_PARTICLES, 3); tables of springs are
 * (NUM_OFFSETS, HALO + NUM_PARTICLES), rest_force = stiffness * rest length; pick is
 * (num_actions, num_pickers), displacement (num_actions, num_pickers, 3), shares (steps).
 * Returns 0, or 1 without memory. */
int rollout(const float *stiffness, const float *rest_force, const float *damping,
            const float *dt_over_mass, Physics physics, const float *start, int num_actions,
            int steps, int num_pickers, const int *pick, const float *displacement,
            const float *shares, float *end) {
  const size_t size = (12 + NUM_OFFSETS) * ROW * sizeof(float);
  float *memory = aligned_alloc(64, size);
  if (!memory) return 1;
  memset(memory, 0, size);
  float *state = memory, *next = memory + 6 * ROW, *tension = memory + 12 * ROW;
  for (int i = 0; i < NUM_PARTICLES; i++)
    for (int axis = 0; axis < 3; axis++) state[axis * ROW + HALO + i] = start[3 * i + axis];
#ifdef __SSE__
  /* Denormal numbers count as zero, as XLA has it. */
  const unsigned mode = _mm_getcsr();
  _mm_setcsr(mode | 0x8040);
#endif
  for (int a = 0; a < num_actions; a++)
    for (int s = 0; s < steps; s++) {
      tensions(state, stiffness, rest_force, damping, physics.shortest, tension);
      integrate(state, tension, dt_over_mass, physics, next);
      carry(state, pick + a * num_pickers, displacement + 3 * a * num_pickers, num_pickers,
            shares[s], physics.time_step, next);
      float *swap = state;
      state = next;
      next = swap;
    }
#ifdef __SSE__
  _mm_setcsr(mode);
#endif
  for (int i = 0; i < NUM_PARTICLES; i++)
    for (int axis = 0; axis < 3; axis++) end[3 * i + axis] = state[axis * ROW + HALO + i];
  free(memory);
  return 0;
}
