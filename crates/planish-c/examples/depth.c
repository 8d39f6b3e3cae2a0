/* Smooths depth images in a loop, in C99: a tilted wall with noise, as a camera would deliver it. */
#include <math.h>
#include <planish/planish.h>
#include <stdio.h>
#include <stdlib.h>

enum { WIDTH = 320, HEIGHT = 240, FRAMES = 5 };

/* Simulates a wall that is 1 mm farther away in each column, with noise of up to 4 mm. */
static void next_frame(uint16_t *depth, unsigned *seed) {
  for (int i = 0; i < WIDTH * HEIGHT; ++i) {
    *seed = *seed * 1664525u + 1013904223u;
    depth[i] = (uint16_t)(1500 + i % WIDTH + (int)(*seed >> 24) % 9 - 4);
  }
}

/* Returns the root mean square distance from the wall in mm. */
static double error_mm(const uint16_t *depth) {
  double sum = 0;
  for (int i = 0; i < WIDTH * HEIGHT; ++i) {
    const double distance = depth[i] - (1500.0 + i % WIDTH);
    sum += distance * distance;
  }
  return sqrt(sum / (WIDTH * HEIGHT));
}

int main(void) {
  uint16_t *depth = malloc(WIDTH * HEIGHT * sizeof *depth), *smoothed = malloc(WIDTH * HEIGHT * sizeof *smoothed);
  float *points = malloc(3 * WIDTH * HEIGHT * sizeof *points);
  if (!depth || !smoothed || !points) return 1;

  const planish_camera camera = {.size = sizeof camera, .width = WIDTH, .height = HEIGHT,
                                 .fx = 262.5, .fy = 262.5, .cx = 159.5, .cy = 119.5};
  const planish_frame frame = {.size = sizeof frame, .kind = PLANISH_DEPTH_U16, .width = WIDTH, .height = HEIGHT,
                               .data = depth, .camera = &camera};
  const planish_output output = {.size = sizeof output, .count = WIDTH * HEIGHT, .points = points, .depth = smoothed};

  planish_session *session = NULL;
  int failed = planish_session_new("engine=cpu", &session) != PLANISH_OK;
  unsigned seed = 1;
  for (int i = 0; i < FRAMES && !failed; ++i) {
    next_frame(depth, &seed);
    failed = planish_smooth(session, &frame, &output) != PLANISH_OK;
    if (!failed) {
      const double before = error_mm(depth), after = error_mm(smoothed);
      printf("frame %d: %.2f mm from the wall, %.2f mm smoothed\n", i, before, after);
      failed = !(after < 0.5 * before);
    }
  }
  if (failed) fprintf(stderr, "%s\n", planish_last_error());
  planish_session_free(session);
  free(depth);
  free(smoothed);
  free(points);
  return failed;
}
