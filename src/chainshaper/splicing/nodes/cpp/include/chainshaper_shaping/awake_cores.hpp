// Keeps idle cores from sleeping while a message is about to be delivered.
//
// A core that sleeps takes tens of microseconds to wake up, on virtual machines more, and never the
// same: most of what a subscriber sees of an output's jitter. While /dev/cpu_dma_latency is held
// open, cores wake up within the microseconds written there, 0 at best
// (Documentation/power/pm_qos_interface.rst). What is written ends with the process. No ROS 2 here.

#ifndef CHAINSHAPER_SHAPING__AWAKE_CORES_HPP_
#define CHAINSHAPER_SHAPING__AWAKE_CORES_HPP_

#include <errno.h>
#include <fcntl.h>
#include <unistd.h>

#include <cstdint>

namespace chainshaper
{

class AwakeCores
{
public:
  AwakeCores()
  : file_(open("/dev/cpu_dma_latency", O_WRONLY | O_CLOEXEC)), refused_(file_ < 0 ? errno : 0)
  {
  }

  AwakeCores(const AwakeCores &) = delete;
  AwakeCores & operator=(const AwakeCores &) = delete;

  ~AwakeCores()
  {
    if (file_ >= 0) {
      close(file_);
    }
  }

  // Why it may not be asked for, as errno says it; 0: it may.
  int refused() const {return refused_;}

  void keep_awake() const {put(0);}

  // As if nothing had been asked for.
  void let_sleep() const {put(-1);}

private:
  void put(std::int32_t latency_us) const
  {
    if (file_ >= 0) {
      [[maybe_unused]] const auto written = write(file_, &latency_us, sizeof(latency_us));
    }
  }

  int file_;
  int refused_;
};

}  // namespace chainshaper

#endif  // CHAINSHAPER_SHAPING__AWAKE_CORES_HPP_
