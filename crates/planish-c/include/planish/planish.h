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
 * - Functions return PLANISH_OK (0) or an error code; planish_last_error() returns the message for the calling thread.
 * - Inputs are borrowed until the call returns. Buffers that are read and buffers that are written must not overlap.
 * - Only one thread may use a session at a time: a call during another thread's call returns PLANISH_BUSY. Different
 *   sessions may be used at the same time. planish_session_stop may be called from any thread at any time.
 * - Using a session or result that was freed is an error (PLANISH_HANDLE), not undefined behaviour. The pointers that
 *   planish_result_get writes are valid until their result is freed.
 * - The setting fill requires the output status, which distinguishes filled pixels from measured ones.
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

// Interleaved points as float in metres; points that are not finite are holes.
#define PLANISH_POINTS_F32 3

// Interleaved points as double in metres; points that are not finite are holes.
#define PLANISH_POINTS_F64 4

// Points as three arrays of float, x, y and z, in metres; points that are not finite are holes.
#define PLANISH_PLANES_F32 5

// Points as three arrays of double, x, y and z, in metres; points that are not finite are holes.
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

// Effective number of video frames averaged into each pixel.
#define PLANISH_FRAMES 128

// Standard error of each point along its ray, in metres.
#define PLANISH_SIGMA 256

// A hole in the input, which stays a hole.
#define PLANISH_STATUS_HOLE 0

// Too few neighbours on a grid: the output is a hole.
#define PLANISH_STATUS_TOO_FEW 1

// The neighbours are on a line: the point is unchanged.
#define PLANISH_STATUS_DEGENERATE 2

// The point is on the fitted plane.
#define PLANISH_STATUS_PLANE 3

// The point is on the fitted polynomial of degree 2.
#define PLANISH_STATUS_POLYNOMIAL2 4

// The point is on the fitted polynomial of degree 3.
#define PLANISH_STATUS_POLYNOMIAL3 5

// Too few neighbours in a cloud without a grid: the point is unchanged.
#define PLANISH_STATUS_ISOLATED 6

// The point is kept from the previous frame.
#define PLANISH_STATUS_CARRIED 7

// A filled hole: nothing was measured here.
#define PLANISH_STATUS_FILLED 8

// A smoother for depth images of one camera in CUDA device memory.
typedef struct planish_cuda planish_cuda;

// A result that the library owns.
typedef struct planish_result planish_result;

// An engine that stays open for frames of any shape, and its settings.
typedef struct planish_session planish_session;

// The return value of a function: 0, or an error code.
typedef int32_t planish_code;

// A pinhole camera.
typedef struct planish_camera {
  // sizeof(planish_camera).
  size_t size;
  // Width of the images in pixels.
  size_t width;
  // Height of the images in pixels.
  size_t height;
  // Horizontal focal length in pixels.
  double fx;
  // Vertical focal length in pixels.
  double fy;
  // Horizontal position of the principal point in pixels from the centre of the first pixel.
  double cx;
  // Vertical position of the principal point in pixels from the centre of the first pixel.
  double cy;
  // Depth units per metre; 0 means 1000 (millimetres).
  double depth_units_per_metre;
  // The name of the distortion model in ROS, OpenCV or Kalibr, such as "plumb_bob" or "equidistant"; null means
  // OpenCV's model.
  const char *distortion_model;
  // The distortion coefficients; null if there are none.
  const double *distortion;
  // The number of distortion coefficients.
  size_t distortion_count;
} planish_camera;

// The arrays of a result. Each has width * height values, or is null if it was not requested.
typedef struct planish_view {
  // Number of columns, or of points without a grid.
  size_t width;
  // Number of rows; 1 for points without a grid.
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
  // Effective number of video frames averaged into each pixel.
  const float *frames;
  // Standard error along the ray, in metres.
  const float *sigma;
} planish_view;

// A depth image, or points. It is borrowed until the call returns.
typedef struct planish_frame {
  // sizeof(planish_frame).
  size_t size;
  // The kind of data: PLANISH_DEPTH_U16, PLANISH_DEPTH_F32, PLANISH_POINTS_F32, PLANISH_POINTS_F64,
  // PLANISH_PLANES_F32 or PLANISH_PLANES_F64.
  uint32_t kind;
  // Number of columns, or of points without a grid.
  size_t width;
  // Number of rows; 1 for points without a grid.
  size_t height;
  // The first depth value, or the first interleaved point.
  const void *data;
  // Bytes from one row to the next; 0 if there are no gaps between rows.
  size_t row_stride;
  // Bytes from one interleaved point to the next; 0 if there are no gaps between points.
  size_t point_stride;
  // Bytes from the beginning of an interleaved point to its x, y and z; all 0 if they come first.
  size_t offsets[3];
  // For PLANISH_PLANES_F32 and PLANISH_PLANES_F64: the arrays of x, y and z, without gaps.
  const void *planes[3];
  // The camera, required for depth images. For points on a grid, it is required only for depth outputs.
  const struct planish_camera *camera;
  // The sensor pose in the coordinate frame of the points: x, y, z in metres, then a quaternion w, x, y, z. Null
  // if unknown; ignored for depth images.
  const double *pose;
  // An origin near the points: x, y, z in metres. Results are relative to it. Null means (0, 0, 0). Georeferenced
  // points need an origin.
  const double *origin_m;
  // Colours of a depth image: red, green and blue of each pixel, without gaps. Null if there are none.
  const uint8_t *rgb;
} planish_frame;

// The caller's buffers, each null if its result is not wanted. Holes are NaN in float buffers and 0 in integer
// buffers.
typedef struct planish_output {
  // sizeof(planish_output).
  size_t size;
  // Number of items in every buffer. Must equal the number of pixels or points of the result
  // (planish_output_shape).
  size_t count;
  // x, y and z of the smoothed points in metres.
  float *points;
  // Bytes from one point to the next, a multiple of 4; 0 if there are no gaps. Bytes between points are left
  // unchanged, unless `gaps_from` is set.
  size_t points_stride;
  // Unit normals towards the sensor.
  float *normals;
  // Bytes from one normal to the next, with the same rules as points_stride. Points and normals may be members of
  // the same structs.
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
  // Effective number of video frames averaged into each pixel; needs the setting temporal.
  float *frames;
  // Standard error of each point along its ray, in metres; needs a grid.
  float *sigma;
  // The first point of an array of structs whose stride is also points_stride, such as the input. The bytes from
  // the end of each point to the next point are copied to the result. Both arrays must have `count` times
  // `points_stride` bytes, and no other output may be in the gaps. Null leaves the gaps unchanged.
  const float *gaps_from;
} planish_output;

// Success.
#define PLANISH_OK 0

// A required pointer is null.
#define PLANISH_NULL 1

// Sizes, strides or buffers contradict each other, or a frame cannot be smoothed.
#define PLANISH_ARGUMENT 2

// A setting is unknown, out of range, or contradicts another one.
#define PLANISH_SETTING 3

// The engine cannot be opened, or it failed.
#define PLANISH_ENGINE 4

// Another thread is using the session or the CUDA smoother.
#define PLANISH_BUSY 5

// The handle does not exist, or was freed.
#define PLANISH_HANDLE 6

// planish_session_stop ended the call.
#define PLANISH_STOPPED 7

// An internal error of planish. Free the session, and report the error.
#define PLANISH_INTERNAL 8

#ifdef __cplusplus
extern "C" {
#endif // __cplusplus

// Creates a smoother for depth images of one camera in CUDA device memory. `kind` is PLANISH_DEPTH_U16 (depth in the
// camera's units) or PLANISH_DEPTH_F32 (depth in metres). `settings` has the form described at planish_session_new;
// its outputs may be points, normals, curvature and depth_m. With engine=gpu, adapter is the index or a part of the
// name of a CUDA device; the default is the current device. Requires NVRTC, CUDA's compiler, which is loaded at run
// time.
planish_code planish_cuda_new(const char *settings,
                              const struct planish_camera *camera,
                              uint32_t kind,
                              struct planish_cuda **cuda);

// Starts smoothing an image on a stream (a cudaStream_t; null means the default stream) and returns without waiting.
// The rows of the image begin `row_stride` bytes apart. `depth` and `result` are addresses in device memory, which
// must stay valid until the stream has finished this work. `result` receives one plane of floats per channel of the
// outputs: x, y and z of points, then of normals, then curvature, depth_m.
planish_code planish_cuda_smooth(struct planish_cuda *cuda,
                                 const void *depth,
                                 size_t row_stride,
                                 float *result,
                                 void *stream);

// Submits an image in the same form as for planish_cuda_smooth; planish_cuda_receive returns the results in the order
// of submission. At most 16 images can be in flight. Images that are submitted before the first call to
// planish_cuda_receive are smoothed together, which takes less time per image.
planish_code planish_cuda_submit(struct planish_cuda *cuda, const void *depth, size_t row_stride, void *stream);

// Smooths the submitted images and copies the oldest result to `result`. `received` becomes false if no image is in
// flight.
planish_code planish_cuda_receive(struct planish_cuda *cuda, float *result, void *stream, bool *received);

// Writes the number of channels of a result to `channels`.
planish_code planish_cuda_channels(const struct planish_cuda *cuda, size_t *channels);

// Waits for the stream, then frees the smoother. Null is allowed.
planish_code planish_cuda_free(struct planish_cuda *cuda);

// Returns the message of this thread's last error in UTF-8; it is empty if there was none. The pointer is valid
// until the next error on this thread.
const char *planish_last_error(void);

// Returns the version of the library, such as "0.1.0".
const char *planish_version(void);

// Writes the arrays of a result to `view`. They are valid until the result is freed.
planish_code planish_result_get(const struct planish_result *result, struct planish_view *view);

// Frees a result. Null is allowed.
planish_code planish_result_free(struct planish_result *result);

// Creates a session. `settings` are words such as "preset=strong engine=cpu", a JSON object such as {"preset":
// "strong"}, or null for the default.
planish_code planish_session_new(const char *settings, struct planish_session **session);

// Frees a session. Null is allowed. A call that is running on another thread continues; call planish_session_stop
// first to end it.
planish_code planish_session_free(struct planish_session *session);

// Sets a setting from text, such as "sensor" to "d435". An empty value restores the default.
planish_code planish_session_set(struct planish_session *session, const char *name, const char *value);

// Sets a numeric setting, such as "radius_m".
planish_code planish_session_set_number(struct planish_session *session, const char *name, double value);

// Sets a boolean setting, such as "remove_isolated".
planish_code planish_session_set_bool(struct planish_session *session, const char *name, bool value);

// Writes the settings as JSON with a terminating zero, truncated to `capacity` bytes. `length` receives the length
// of the whole text in bytes, without the zero.
planish_code planish_session_settings(const struct planish_session *session,
                                      char *buffer,
                                      size_t capacity,
                                      size_t *length);

// Writes the name of the open engine, such as "cpu" or "gpu: NVIDIA H100"; it is empty before the first frame.
// `capacity` and `length` are as in planish_session_settings.
planish_code planish_session_engine(const struct planish_session *session,
                                    char *buffer,
                                    size_t capacity,
                                    size_t *length);

// Writes the next event and removes it from the queue. An event is a sentence about something that the session
// decided or detected by itself, such as a lost GPU or a camera that does not fit. `length` becomes 0 if there is no
// event. An event that is longer than the buffer is truncated and stays in the queue.
planish_code planish_next_event(struct planish_session *session, char *buffer, size_t capacity, size_t *length);

// Stops another thread's smoothing of an unorganized cloud with this session; its call returns PLANISH_STOPPED.
// Calls with frames on a grid are too short to be stopped.
planish_code planish_session_stop(const struct planish_session *session);

// Starts a new video: earlier frames have no effect on the next one.
planish_code planish_session_restart_video(struct planish_session *session);

// Sets the pose of the camera in the world for the next frame of a video: x, y, z in metres, then a quaternion w, x,
// y, z. Null means that the pose is unknown.
planish_code planish_session_set_camera_pose(struct planish_session *session, const double *pose);

// Writes the width and height of the result for a frame of the given width and height. They are smaller than the
// frame's only with the setting decimate.
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

// Submits a frame. planish_receive returns the results in the order of submission. The frame is either copied or
// smoothed during this call. A GPU works on several frames at a time. `outputs` is as in planish_smooth_new.
planish_code planish_submit(struct planish_session *session, const struct planish_frame *frame, uint32_t outputs);

// Waits for the oldest frame in flight and writes its result. `received` becomes false if no frame is in flight.
planish_code planish_receive(struct planish_session *session, const struct planish_output *output, bool *received);

// Writes the number of frames in flight to `in_flight` and the maximum number to `most`.
planish_code planish_in_flight(const struct planish_session *session, size_t *in_flight, size_t *most);

#ifdef __cplusplus
}  // extern "C"
#endif  // __cplusplus

#endif  /* PLANISH_H */
