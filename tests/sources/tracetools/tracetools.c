/* A `libtracetools.so` without LTTng. With -DDISABLED it has no trace points, as when built with
   TRACETOOLS_DISABLED. */

#define TRACE_POINT {}
#include "tracetools.h"

bool ros_trace_compile_status(void) { return true; }
