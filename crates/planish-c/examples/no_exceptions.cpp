// Built with -fno-exceptions: calls return a planish::Result.
#include <planish/planish.hpp>

#include <cstdio>
#include <vector>

int main() {
  planish::Session wrong("preset=huge");
  if (wrong.error()) return 1;
  std::printf("%s\n", wrong.error().text().c_str());

  planish::Session session("engine=cpu");
  const planish::Result set = session.set("strength", 2.0);
  std::printf("%s\n", set.text().c_str());
  if (set || set.code() != PLANISH_SETTING || !session.set("strength", 0.8)) return 1;

  std::vector<std::uint16_t> depth(160 * 120, 1500);
  std::vector<float> points(3 * depth.size());
  const planish::Camera camera(160, 120, 131.25, 131.25, 79.5, 59.5);
  const planish::Result done =
      session.smooth(planish::depth(depth.data(), camera), planish::Output(depth.size()).points(points.data()));
  std::printf("%s with %s: z %.4f\n", session.engine().c_str(), session.settings().c_str(), points[3 * 9000 + 2]);
  return done ? 0 : 1;
}
