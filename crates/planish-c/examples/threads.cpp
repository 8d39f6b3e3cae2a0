// Several threads with one session each, two threads that share a session, and errors in between. `threads CALLS
// THREADS` runs a soak test.
#include <planish/planish.hpp>

#include <atomic>
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <random>
#include <string>
#include <thread>
#include <vector>

namespace {
std::atomic<int> failures{0};
void expect(bool is_true, const char *what) {
  if (is_true) return;
  std::printf("FAILED: %s\n", what);
  ++failures;
}

/// Smooths frames of random sizes; every tenth frame has one of several errors.
void calls(unsigned seed, long count) {
  std::mt19937 random(seed);
  auto below = [&](std::size_t n) { return static_cast<std::size_t>(random() % n); };
  // Every other session has two threads of its own.
  const std::string engine = seed % 2 ? "engine=cpu threads=2" : "engine=cpu threads=1";
  planish::Session session(engine);
  for (long i = 0; i < count; ++i) {
    const std::size_t width = 4 + below(29), height = 4 + below(21), pixels = width * height;
    std::vector<std::uint16_t> depth(pixels, 1200), result(pixels);
    for (auto &value : depth) value = static_cast<std::uint16_t>(value + below(7));
    // Every fourth value is a gap between points.
    std::vector<float> points(4 * pixels), gaps(4 * pixels, static_cast<float>(i)), normals(3 * pixels);
    const planish::Camera camera(width, height, 40, 40, 16, 12);
    auto frame = planish::depth(depth.data(), camera);
    planish::Output output(pixels);
    output.points(points.data(), 16).gaps_from(gaps.data()).depth(result.data());
    const bool is_wrong = i % 10 == 9;
    switch (is_wrong ? below(8) : 9) {
      case 0: frame.data(nullptr); break;
      case 1: frame.row_stride(2 * width - 2); break;
      case 2: output.points(points.data(), 10); break;
      case 3: output.depth(depth.data()); break;
      case 4: output = planish::Output(pixels + 1).points(points.data(), 16); break;
      case 5: output.gaps_from(points.data()); break;
      case 6: output.points(nullptr, 16); break;
      case 7: output.normals(points.data() + 1, 16); break;
      default: output.normals(normals.data()); break;
    }
    const planish::Result done = session.try_smooth(frame, output);
    expect(static_cast<bool>(done) != is_wrong, "exactly the invalid calls fail");
    expect(!is_wrong || !done.text().empty(), "an error has a message");
    if (!is_wrong) expect(points[4 * pixels - 1] == static_cast<float>(i), "gaps are copied, after the last point too");
    if (!is_wrong) expect(std::abs(points[4 * (pixels / 2) + 2] - 1.203f) < 0.01f, "the wall stays where it is");
    // Now and then, open another session, or keep a result in the library's memory.
    if (i % 1000 == 500) session = planish::Session(engine + " preset=light");
    if (i % 50 == 25) {
      planish::Smoothed smoothed;
      expect(static_cast<bool>(session.try_smooth(planish::depth(depth.data(), camera), PLANISH_POINTS, smoothed)), "owned");
      expect(smoothed.points(2).size() == pixels, "owned results have every pixel");
    }
  }
}
}  // namespace

int main(int argc, char **argv) {
  const long count = argc > 1 ? std::atol(argv[1]) : 2000;
  const int threads = argc > 2 ? std::atoi(argv[2]) : 4;
  std::vector<std::thread> all;
  for (int i = 0; i < threads; ++i) all.emplace_back(calls, static_cast<unsigned>(i), count / threads);
  for (auto &thread : all) thread.join();

  // Two threads share one session: a call during the other thread's call is rejected, without harm.
  planish::Session shared("engine=cpu threads=1");
  const std::vector<std::uint16_t> depth(64 * 48, 1500);
  const planish::Camera camera(64, 48, 52.5, 52.5, 31.5, 23.5);
  std::atomic<long> done{0}, busy{0};
  auto use = [&] {
    std::vector<float> points(3 * depth.size());
    for (int i = 0; i < 50; ++i) {
      const auto result = shared.try_smooth(planish::depth(depth.data(), camera), planish::Output(depth.size()).points(points.data()));
      result ? ++done : ++busy;
      expect(result || result.code() == PLANISH_BUSY, "a session in use returns PLANISH_BUSY");
    }
  };
  std::thread one(use), other(use);
  one.join();
  other.join();
  std::printf("%ld calls by %d threads; one session for two threads: %ld done, %ld refused\n", count, threads, done.load(), busy.load());

  // A freed handle, and a null handle.
  planish_session *session = nullptr;
  expect(planish_session_new("", &session) == PLANISH_OK && planish_session_free(session) == PLANISH_OK, "free");
  expect(planish_session_free(session) == PLANISH_HANDLE, "freed twice");
  expect(planish_session_set(session, "degree", "2") == PLANISH_HANDLE, "used after it was freed");
  expect(planish_session_set(nullptr, "degree", "2") == PLANISH_NULL, "null");
  return failures != 0;
}
