/* planish for C: smooths depth-camera frames and point clouds. Generated from crates/planish-c/src; do not edit.
 *
 * A session keeps an engine open for frames of any shape:
 *
 *   planish_session *session = NULL;
 *   planish_camera camera = {.size = sizeof camera, .width = 640, .height = 480,
 *                            .fx = 525, .fy = 525, .cx = 319.5, .cy = 239.5};
 *   planish_frame frame = {.size = sizeof frame, .kind = PLANISH_DEPTH_U16, .width = 640, .height = 480,
 *                          .data = depth, .camera = &camera};
 *   planish_output out = {.size = sizeof out, .count = 640 * 480, .points = points};
 *   if (planish_session_new("preset=default", &session) || planish_smooth(session, &frame, &out))
 *     fprintf(stderr, "%s\n", planish_last_error());
 *   planish_session_free(session);
 *
 * Rules
 * - Set the first member `size` of a struct to its sizeof, and members that you do not need to 0.
 * - Functions return PLANISH_OK, which is 0, or an error; planish_last_error() has its text, for the thread that called.
 * - Inputs are borrowed until the call returns. Buffers that are read and buffers that are written must not overlap.
 * - A session belongs to one thread at a time: a call while another thread is in one returns PLANISH_BUSY. Different
 *   sessions may be used at the same time. planish_session_stop may be called from any thread at any time.
 * - A session or result that was freed is an error (PLANISH_HANDLE), not undefined behaviour. The pointers that
 *   planish_result_get returns end with their result.
 * - The setting fill needs the output status, which tells filled pixels from measured ones.
 * - No function throws or prints. Running out of memory ends the process. */

#ifndef PLANISH_H
#define PLANISH_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

// Depth in the camera's units; 0 and 65535 are holes.
#define PLANISH_DEPTH_U16 1

// Depth in metres; values that are not finite or not positive are holes.
#define PLANISH_DEPTH_F32 2

// Interleaved points of float in metres; a point that is not finite is a hole.
#define PLANISH_POINTS_F32 3

// Interleaved points of double.
#define PLANISH_POINTS_F64 4

// Points as three arrays of float: x, y and z.
#define PLANISH_PLANES_F32 5

// Points as three arrays of double.
#define PLANISH_PLANES_F64 6

// The smoothed points.
#define PLANISH_POINTS 1

// Unit normals towards the sensor.
#define PLANISH_NORMALS 2

// Surface variation, 0 to 1/3.
#define PLANISH_CURVATURE 4

// The status of each pixel.
#define PLANISH_STATUS 8

// The number of neighbours of each pixel.
#define PLANISH_NEIGHBOURS 16

// Depth in the camera's units.
#define PLANISH_DEPTH 32

// Depth in metres.
#define PLANISH_DEPTH_M 64

// Effective number of frames of a video in each pixel.
#define PLANISH_FRAMES 128

// Standard error of each point along its ray, in metres.
#define PLANISH_SIGMA 256

// No measurement came in, none goes out.
#define PLANISH_STATUS_HOLE 0

// Too few neighbours on a grid: the output is a hole.
#define PLANISH_STATUS_TOO_FEW 1

// The neighbours are on a line: the point is unchanged.
#define PLANISH_STATUS_DEGENERATE 2

// On a plane.
#define PLANISH_STATUS_PLANE 3

// On a polynomial of degree 2.
#define PLANISH_STATUS_POLYNOMIAL2 4

// On a polynomial of degree 3.
#define PLANISH_STATUS_POLYNOMIAL3 5

// Too few neighbours in a cloud without a grid: the point is unchanged.
#define PLANISH_STATUS_ISOLATED 6

// Kept from the frame before.
#define PLANISH_STATUS_CARRIED 7

// A filled hole: nothing was measured here.
#define PLANISH_STATUS_FILLED 8

// Smooths depth images of one camera in CUDA's memory.
typedef struct planish_cuda planish_cuda;

// A result that the library owns.
typedef struct planish_result planish_result;

// An engine that is kept open for frames of any shape, and its settings.
typedef struct planish_session planish_session;

// The result of a function: 0, or an error code.
typedef int32_t planish_code;

// A pinhole camera.
typedef struct planish_camera {
  // sizeof(planish_camera).
  size_t size;
  // Pixels of its images.
  size_t width;
  // Rows of its images.
  size_t height;
  // Focal length in pixels.
  double fx;
  // Focal length in pixels.
  double fy;
  // Principal point in pixels from the centre of the first one.
  double cx;
  // Principal point in pixels.
  double cy;
  // Depth units in a metre; 0 means 1000, for millimetres.
  double depth_units_per_metre;
  // The name of the lens distortion in ROS, OpenCV or Kalibr, such as "plumb_bob" or "equidistant"; null for
  // OpenCV's.
  const char *distortion_model;
  // The coefficients of the distortion; null for none.
  const double *distortion;
  // How many there are.
  size_t distortion_count;
} planish_camera;

// The arrays of a result. Each has width * height values, or is null if it was not requested.
typedef struct planish_view {
  // Columns, or points.
  size_t width;
  // Rows; 1 for points without a grid.
  size_t height;
  // x, y and z of the smoothed points in metres.
  const float *points[3];
  // x, y and z of the unit normals towards the sensor.
  const float *normals[3];
  // Surface variation.
  const float *curvature;
  // One of PLANISH_STATUS_... for each pixel.
  const uint8_t *status;
  // Number of neighbours.
  const uint32_t *neighbours;
  // Depth in the camera's units.
  const uint16_t *depth;
  // Depth in metres.
  const float *depth_m;
  // Effective number of frames of a video.
  const float *frames;
  // Standard error along the ray, in metres.
  const float *sigma;
} planish_view;

// A depth image, or points. It is borrowed until the call returns.
typedef struct planish_frame {
  // sizeof(planish_frame).
  size_t size;
  // Its kind: PLANISH_DEPTH_U16, PLANISH_DEPTH_F32, PLANISH_POINTS_F32, PLANISH_POINTS_F64,
  // PLANISH_PLANES_F32 or PLANISH_PLANES_F64.
  uint32_t kind;
  // Columns, or the number of points without a grid.
  size_t width;
  // Rows; 1 for points without a grid.
  size_t height;
  // The first depth value, or the first interleaved point.
  const void *data;
  // Bytes from one row to the next; 0 if rows follow each other without a gap.
  size_t row_stride;
  // Bytes from one interleaved point to the next; 0 if they follow each other without a gap.
  size_t point_stride;
  // Bytes from the beginning of an interleaved point to its x, y and z; all 0 if they come first.
  size_t offsets[3];
  // x, y and z of PLANISH_PLANES_F32 and PLANISH_PLANES_F64, without gaps.
  const void *planes[3];
  // The camera of a depth image. Points on a grid may have one: then depth can be had of them.
  const struct planish_camera *camera;
  // The sensor pose in the frame of the points: x, y, z in metres, then a quaternion w, x, y, z. Null if unknown;
  // ignored for depth images.
  const double *pose;
  // x, y, z of an origin near the points, to which results are relative; null for (0, 0, 0). Georeferenced points
  // need one.
  const double *origin_m;
  // Colours of a depth image, red, green and blue of each pixel without gaps; null for none.
  const uint8_t *rgb;
} planish_frame;

// The caller's buffers, each null if the result is not wanted. Holes are NaN, in integers 0.
typedef struct planish_output {
  // sizeof(planish_output).
  size_t size;
  // Items that every buffer has room for: the pixels or points of the result (planish_output_shape).
  size_t count;
  // x, y and z of the smoothed points in metres.
  float *points;
  // Bytes from one point to the next, a multiple of 4; 0 if they follow each other without a gap. Bytes between
  // points are left unchanged.
  size_t points_stride;
  // Unit normals towards the sensor.
  float *normals;
  // Bytes from one normal to the next, as of points. Points and normals may be members of the same structs.
  size_t normals_stride;
  // Surface variation l0/(l0+l1+l2), 0 to 1/3.
  float *curvature;
  // One of PLANISH_STATUS_... for each pixel.
  uint8_t *status;
  // Number of neighbours.
  uint32_t *neighbours;
  // Depth in the camera's units; needs a camera.
  uint16_t *depth;
  // Depth in metres; needs a camera.
  float *depth_m;
  // Effective number of frames of a video in each pixel; needs the setting temporal.
  float *frames;
  // Standard error of each point along its ray, in metres; needs a grid.
  float *sigma;
} planish_output;

// Success.
#define PLANISH_OK 0

// A pointer is null that must not be.
#define PLANISH_NULL 1

// Sizes, strides or buffers contradict each other, or a frame cannot be smoothed as it is.
#define PLANISH_ARGUMENT 2

// A setting is unknown, out of range, or contradicts another one.
#define PLANISH_SETTING 3

// The engine cannot be opened, or failed.
#define PLANISH_ENGINE 4

// Another thread is using the session.
#define PLANISH_BUSY 5

// The session or result was freed, or was never one.
#define PLANISH_HANDLE 6

// planish_session_stop ended the call.
#define PLANISH_STOPPED 7

// A fault of planish. Free the session, and report it.
#define PLANISH_INTERNAL 8

#ifdef __cplusplus
extern "C" {
#endif // __cplusplus

// Makes a smoother for depth images of one camera in CUDA's memory: PLANISH_DEPTH_U16 in the camera's units or
// PLANISH_DEPTH_F32 in metres. Takes the settings of planish_session_new; outputs may be points, normals, curvature and
// depth_m. With engine=gpu, adapter is the number or a part of the name of a CUDA device, by default the current one.
// Needs NVRTC, CUDA's compiler, which is loaded at run time.
planish_code planish_cuda_new(const char *settings,
                              const struct planish_camera *camera,
                              uint32_t kind,
                              struct planish_cuda **cuda);

// Smooths an image whose rows begin every `row_stride` bytes, on a stream (a cudaStream_t; null is the default one),
// and returns at once. Both addresses are in device memory and must stay valid until the stream has used them.
// `result` has a plane of floats for each channel of the outputs: x, y and z of points, then of normals, then
// curvature, depth_m.
planish_code planish_cuda_smooth(struct planish_cuda *cuda,
                                 const void *depth,
                                 size_t row_stride,
                                 float *result,
                                 void *stream);

// Hands an image over as planish_cuda_smooth does; its result is received later, in the same order. Up to 16 may be in
// flight. Images that are handed over before the first result is received are smoothed together, in less time for each.
planish_code planish_cuda_submit(struct planish_cuda *cuda, const void *depth, size_t row_stride, void *stream);

// Smooths the images that were handed over, and copies the oldest result; `received` is false if none is in flight.
planish_code planish_cuda_receive(struct planish_cuda *cuda, float *result, void *stream, bool *received);

// Returns the number of channels of a result.
planish_code planish_cuda_channels(const struct planish_cuda *cuda, size_t *channels);

// Waits for the stream, then frees the smoother. Null is allowed.
planish_code planish_cuda_free(struct planish_cuda *cuda);

// Returns the text of the last error of a function called on this thread, in UTF-8; empty if there was none. It is
// valid until the next error on this thread.
const char *planish_last_error(void);

// Returns the version of the library, such as "0.1.0".
const char *planish_version(void);

// Returns the arrays of a result, which end with it.
planish_code planish_result_get(const struct planish_result *result, struct planish_view *view);

// Frees a result. Null is allowed.
planish_code planish_result_free(struct planish_result *result);

// Makes a session. `settings` are words such as "preset=strong engine=cpu", a JSON object such as
// {"preset": "strong"}, or null for the default.
planish_code planish_session_new(const char *settings, struct planish_session **session);

// Frees a session. Null is allowed. A call in another thread continues until it is done; stop it first.
planish_code planish_session_free(struct planish_session *session);

// Sets a setting by its name and value as text, such as "sensor" and "d435"; an empty value is the default.
planish_code planish_session_set(struct planish_session *session, const char *name, const char *value);

// Sets a setting that is a number, such as "radius_m".
planish_code planish_session_set_number(struct planish_session *session, const char *name, double value);

// Sets a setting that is true or false, such as "remove_isolated".
planish_code planish_session_set_bool(struct planish_session *session, const char *name, bool value);

// Writes the settings as JSON, ended by a zero and cut off after `capacity` bytes; `length` is its whole length.
planish_code planish_session_settings(const struct planish_session *session,
                                      char *buffer,
                                      size_t capacity,
                                      size_t *length);

// Writes the name of the engine that is open, such as "cpu" or "gpu: NVIDIA H100"; empty before the first frame.
planish_code planish_session_engine(const struct planish_session *session,
                                    char *buffer,
                                    size_t capacity,
                                    size_t *length);

// Takes the next thing that the session decided or found without being asked, as a sentence: a GPU that was lost, a
// camera that does not fit. Without one, `length` is 0. An event longer than the buffer is kept.
planish_code planish_next_event(struct planish_session *session, char *buffer, size_t capacity, size_t *length);

// Stops the cloud that another thread is smoothing with this session; its call returns PLANISH_STOPPED. Frames on a
// grid take too little time to be stopped.
planish_code planish_session_stop(const struct planish_session *session);

// Starts a new video: earlier frames have no effect on the next one.
planish_code planish_session_restart_video(struct planish_session *session);

// Tells where the camera of the next frame of a video is in the world: x, y, z in metres, then a quaternion w, x, y,
// z. Null means that it is not known.
planish_code planish_session_set_camera_pose(struct planish_session *session, const double *pose);

// Returns the columns and rows of the result for a frame of this size; they differ with the setting decimate.
planish_code planish_output_shape(const struct planish_session *session,
                                  size_t width,
                                  size_t height,
                                  size_t *output_width,
                                  size_t *output_height);

// Smooths a frame into the caller's buffers.
planish_code planish_smooth(struct planish_session *session,
                            const struct planish_frame *frame,
                            const struct planish_output *output);

// Smooths a frame into a result that the library owns. `outputs` is a sum of PLANISH_POINTS, PLANISH_NORMALS and so
// on.
planish_code planish_smooth_new(struct planish_session *session,
                                const struct planish_frame *frame,
                                uint32_t outputs,
                                struct planish_result **result);

// Hands a frame over; its result is received later, in the same order. The frame is copied, or smoothed at once. A GPU
// works on several frames at a time.
planish_code planish_submit(struct planish_session *session, const struct planish_frame *frame, uint32_t outputs);

// Waits for the oldest frame in flight, and writes its result. `received` is false if none is in flight.
planish_code planish_receive(struct planish_session *session, const struct planish_output *output, bool *received);

// Returns how many frames are in flight, and how many may be.
planish_code planish_in_flight(const struct planish_session *session, size_t *in_flight, size_t *most);

#ifdef __cplusplus
}  // extern "C"
#endif  // __cplusplus

#endif  /* PLANISH_H */
