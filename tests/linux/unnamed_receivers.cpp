// A stand-in for Fast DDS before 2.13, whose threads have no names, and a program that has it:
//
//   g++ -DLIBRARY -shared … -o libfastrtps.so, and the program with the file of a port's memory
//
// Each thread says what it waits for, and its id; the program's own has published before.
#include <netinet/in.h>
#include <sys/mman.h>
#include <sys/socket.h>
#include <sys/syscall.h>
#include <unistd.h>

#include <cstdint>
#include <cstdio>
#include <fcntl.h>
#include <linux/futex.h>
#include <thread>

void say(const char * what) {
  std::printf("%s %ld\n", what, syscall(SYS_gettid));
  std::fflush(stdout);
}

void receive(const char * what) {
  const int own = socket(AF_INET, SOCK_DGRAM, 0);
  char byte;
  say(what);
  if (recv(own, &byte, 1, 0) < 0) std::perror("recv");
}

#ifdef LIBRARY
extern "C" void publish(char * message) {
  volatile char copy[2048];
  for (auto & byte : copy) byte = *message;
}

extern "C" void participate(std::uint32_t * port) {
  std::thread([] { receive("datagrams"); }).detach();
  std::thread([port] {
    say("port");
    syscall(SYS_futex, port, FUTEX_WAIT, 0, nullptr, nullptr, 0);
  }).detach();
  std::thread([] {
    say("events");
    pause();
  }).detach();
}
#else
extern "C" void publish(char * message);
extern "C" void participate(std::uint32_t * port);

int main(int, char ** words) {
  const int file = open(words[1], O_RDWR);
  void * memory = mmap(nullptr, 4096, PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);
  participate(static_cast<std::uint32_t *>(memory));
  std::thread([words] {
    publish(words[1]);
    receive("own");
  }).detach();
  pause();
}
#endif
