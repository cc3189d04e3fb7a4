// Callbacks as rclcpp keeps them: members of a timer's class template, and std::function.
// Prints their addresses, one a line, then waits for its standard input to end.

#include <cstdio>
#include <functional>
#include <map>
#include <memory>
#include <string>
#include <vector>

namespace rclcpp
{

class TimerBase
{
public:
  virtual ~TimerBase() = default;
  std::shared_ptr<int> clock, handle;
  char mutex[40];
};

template<typename FunctorT, std::nullptr_t = nullptr>
class GenericTimer : public TimerBase
{
public:
  explicit GenericTimer(FunctorT callback) : callback(std::move(callback)) {}
  FunctorT callback;
};

template<typename FunctorT>
class WallTimer : public GenericTimer<FunctorT>
{
public:
  using GenericTimer<FunctorT>::GenericTimer;
};

template<typename ArgumentT>
class Subscription
{
public:
  explicit Subscription(std::function<void(ArgumentT)> callback) : callback(std::move(callback)) {}
  virtual ~Subscription() = default;
  std::function<void(ArgumentT)> callback;
};

}  // namespace rclcpp

using Message = std::shared_ptr<const std::map<std::string, int>>;

struct Relay
{
  void on_message(Message) {}
  void tick() {}
};

void service(int) {}

template<typename ArgumentT>
void * subscribed(std::function<void(ArgumentT)> callback)
{
  return &(new rclcpp::Subscription<ArgumentT>(std::move(callback)))->callback;
}

template<typename FunctorT>
void * added(FunctorT callback)
{
  return &(new rclcpp::WallTimer<FunctorT>(std::move(callback)))->callback;
}

int main()
{
  Relay relay;
  std::vector<void *> callbacks{
    added([&relay] {relay.tick();}),
    added(std::bind(&Relay::tick, &relay)),
    added(std::function<void()>(std::bind(&Relay::tick, &relay))),
    subscribed<Message>([&relay](Message message) {relay.on_message(message);}),
    subscribed<Message>(std::bind(&Relay::on_message, &relay, std::placeholders::_1)),
    subscribed<int>(&service),
    new long[128]{},
  };
  callbacks.back() = static_cast<long *>(callbacks.back()) + 64;
  for (auto callback : callbacks) {
    std::printf("%zu\n", reinterpret_cast<std::size_t>(callback));
  }
  std::fflush(stdout);
  return std::getchar() == EOF ? 0 : 1;
}
