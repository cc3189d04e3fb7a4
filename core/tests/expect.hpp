// What a test expects; the first thing that is otherwise ends it.

#pragma once

#include <cstdlib>
#include <iostream>
#include <stdexcept>

#define EXPECT(condition)                                                             \
  do {                                                                                \
    if (!(condition)) {                                                               \
      std::cerr << __FILE__ << ':' << __LINE__ << ": not so: " << #condition << '\n'; \
      std::exit(EXIT_FAILURE);                                                        \
    }                                                                                 \
  } while (false)

// The invalid argument that a call is refused for.
#define EXPECT_REFUSED(call)                  \
  do {                                        \
    bool refused = false;                     \
    try {                                     \
      call;                                   \
    } catch (const std::invalid_argument &) { \
      refused = true;                         \
    }                                         \
    EXPECT(refused && #call);                 \
  } while (false)
