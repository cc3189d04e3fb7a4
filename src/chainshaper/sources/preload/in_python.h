// Callbacks of rclpy, whose executors emit no events: what has them emitted is run in the node's own
// interpreter (`rclpy_hook.py`). Nothing in the environment leads it there, no file lies anywhere, and
// the interpreter's options (`-I`, `-S`, virtual environments, a `sitecustomize`) do not matter: when
// `rclpy.init` calls `rcl_init`, the thread that calls has the interpreter's lock, and may run Python.
// No lock of rclpy is held there, as it is in `rcl_node_init` (that of its logging).
//
// Functions of the interpreter are looked up by name; all of them are in its stable ABI, or have been
// exported by each version from 3.8 on. Where one is missing, or anything fails, callbacks are
// inferred as they are without this, and the recording says why.
#pragma once
#include "rclpy_hook.h"  // made when this is built, by events_header.py

typedef struct py_object py_object;
typedef struct {  // PyMethodDef
  const char *name;
  py_object *(*call)(py_object *, py_object *, py_object *);
  int flags;
  const char *help;
} py_method;
enum { PY_ARGUMENTS = 1, PY_NAMED_ARGUMENTS = 2, PY_FILE = 257 };

// EACH(type of result, name, parameters)
#define PYTHON_FUNCTIONS(EACH) \
  EACH(void *, PyGILState_GetThisThreadState, (void)) \
  EACH(py_object *, PyErr_Occurred, (void)) \
  EACH(void, PyErr_Clear, (void)) \
  EACH(int, PyErr_ExceptionMatches, (py_object *)) \
  EACH(void, PyErr_SetInterrupt, (void)) \
  EACH(py_object *, PyEval_GetBuiltins, (void)) \
  EACH(py_object *, PyEval_EvalCode, (py_object *, py_object *, py_object *)) \
  EACH(py_object *, Py_CompileString, (const char *, const char *, int)) \
  EACH(py_object *, PyDict_New, (void)) \
  EACH(int, PyDict_SetItemString, (py_object *, const char *, py_object *)) \
  EACH(py_object *, PyDict_GetItemString, (py_object *, const char *)) \
  EACH(py_object *, PyCFunction_NewEx, (py_method *, py_object *, py_object *)) \
  EACH(py_object *, PyTuple_GetItem, (py_object *, intptr_t)) \
  EACH(py_object *, PyTuple_New, (intptr_t)) \
  EACH(int, PyTuple_SetItem, (py_object *, intptr_t, py_object *)) \
  EACH(int, PyArg_ParseTuple, (py_object *, const char *, ...)) \
  EACH(py_object *, PyObject_Call, (py_object *, py_object *, py_object *)) \
  EACH(py_object *, Py_BuildValue, (const char *, ...)) \
  EACH(const char *, PyUnicode_AsUTF8, (py_object *)) \
  EACH(void, Py_IncRef, (py_object *)) \
  EACH(void, Py_DecRef, (py_object *))

// NOLINTBEGIN(bugprone-macro-parentheses): in brackets a type, or a list of parameters, is none.
#define PYTHON_POINTER(type, name, parameters) type(*name) parameters;
// NOLINTEND(bugprone-macro-parentheses)
static struct {
  PYTHON_FUNCTIONS(PYTHON_POINTER)
  void *(*current_thread)(void);  // that has the interpreter's lock; NULL: none, or another one
} py;

static bool find_python(void) {
#define LOOK_UP(type, name, parameters) \
  *(void **)(void *)&py.name = dlsym(RTLD_DEFAULT, #name); \
  if (!py.name) return false;
  PYTHON_FUNCTIONS(LOOK_UP)
  void *current = dlsym(RTLD_DEFAULT, "PyThreadState_GetUnchecked");  // from 3.13 on
  if (!current) current = dlsym(RTLD_DEFAULT, "_PyThreadState_UncheckedGet");
  *(void **)(void *)&py.current_thread = current;
  return current;
}

// A callback that is traced. Its handle is the address of `self`, a tuple with the callback.
static py_object *call_traced(py_object *self, py_object *arguments, py_object *named) {
  py_object *callback = py.PyTuple_GetItem(self, 0);
  if (!callback) return NULL;
  ros_trace_callback_start((uintptr_t)self, 0, 0, 0, 0);
  py_object *result = py.PyObject_Call(callback, arguments, named);
  ros_trace_callback_end((uintptr_t)self, 0, 0, 0, 0);
  return result;
}

// traced(callback): the function that calls it, and its handle.
static py_object *make_traced(py_object *unused, py_object *arguments, py_object *named) {
  static py_method method = {"callback", call_traced, PY_ARGUMENTS | PY_NAMED_ARGUMENTS, NULL};
  py_object *callback = NULL;
  (void)unused, (void)named;
  if (!py.PyArg_ParseTuple(arguments, "O", &callback)) return NULL;
  py_object *self = py.PyTuple_New(1);
  if (!self) return NULL;
  py.Py_IncRef(callback);
  if (py.PyTuple_SetItem(self, 0, callback)) return NULL;
  py_object *function = py.PyCFunction_NewEx(&method, self, NULL);
  unsigned long long handle = (uintptr_t)self;
  py.Py_DecRef(self);  // the function has it
  return function ? py.Py_BuildValue("NK", function, handle) : NULL;
}

// registered(kind, entity, callback, owner, symbol)
static py_object *registered(py_object *unused, py_object *arguments, py_object *named) {
  enum { TIMER, SUBSCRIPTION, SERVICE, OF_NODE, TIMER_OF_NODE };
  int kind = 0;
  unsigned long long entity = 0, callback = 0, owner = 0;
  const char *symbol = NULL;
  (void)unused, (void)named;
  if (!py.PyArg_ParseTuple(arguments, "iKKKs", &kind, &entity, &callback, &owner, &symbol)) return NULL;
  if (kind == TIMER) ros_trace_rclcpp_timer_callback_added(entity, callback, 0, 0, 0);
  if (kind == SERVICE) ros_trace_rclcpp_service_callback_added(entity, callback, 0, 0, 0);
  if (kind == OF_NODE) ros_trace_rclpy_callback_added(callback, owner, 0, 0, 0);
  if (kind == TIMER_OF_NODE) ros_trace_rclcpp_timer_link_node(entity, owner, 0, 0, 0);
  if (kind == SUBSCRIPTION) {
    ros_trace_rclcpp_subscription_init(entity, owner, 0, 0, 0);
    ros_trace_rclcpp_subscription_callback_added(owner, callback, 0, 0, 0);
  }
  if (callback) ros_trace_rclcpp_callback_register(callback, (uintptr_t)symbol, 0, 0, 0);
  return py.Py_BuildValue("");
}

// step(callback, call, state)
static py_object *step(py_object *unused, py_object *arguments, py_object *named) {
  enum { BEGINS_, RUNS, WAITS, DONE };  // places in COROUTINE_STATES; a task is created behind them
  unsigned long long callback = 0, call = 0;
  int state = 0;
  (void)unused, (void)named;
  if (!py.PyArg_ParseTuple(arguments, "KKi", &callback, &call, &state)) return NULL;
  if (state == BEGINS_ || state == RUNS) began_callback(call, HERE);
  if (state == WAITS || state == DONE) ended_callback(call);
  ros_trace_coroutine_step(callback, call, 0, (uint64_t)state, 0);
  return py.Py_BuildValue("");
}

// Run the hook in the thread that has the interpreter's lock; return whether there is a rclpy. What the
// hook could not do is recorded.
static bool run_hook(void) {
  static py_method given[] = {{"traced", make_traced, PY_ARGUMENTS | PY_NAMED_ARGUMENTS, NULL},
                              {"registered", registered, PY_ARGUMENTS | PY_NAMED_ARGUMENTS, NULL},
                              {"step", step, PY_ARGUMENTS | PY_NAMED_ARGUMENTS, NULL}};
  py_object *globals = py.PyDict_New();
  if (!globals) return false;
  bool whole = py.PyDict_SetItemString(globals, "__builtins__", py.PyEval_GetBuiltins()) == 0;
  for (unsigned place = 0; place < sizeof given / sizeof *given; place++) {
    py_object *function = py.PyCFunction_NewEx(&given[place], NULL, NULL);
    whole = whole && function && py.PyDict_SetItemString(globals, given[place].name, function) == 0;
    if (function) py.Py_DecRef(function);
  }
  py_object *code = whole ? py.Py_CompileString(rclpy_hook, "<chainshaper>", PY_FILE) : NULL;
  py_object *result = code ? py.PyEval_EvalCode(code, globals, globals) : NULL;
  py_object *problem = result ? py.PyDict_GetItemString(globals, "problem") : NULL;
  const void *none = dlsym(RTLD_DEFAULT, "_Py_NoneStruct");
  bool is_rclpy = !result || (problem && problem != none);
  const char *text = result && is_rclpy ? py.PyUnicode_AsUTF8(problem) : NULL;
  if (is_rclpy)
    ros_trace_rclpy_followed((uintptr_t)(text ? text : "the interpreter did not run the hook"), 0, 0, 0, 0);
  py_object **interrupt = dlsym(RTLD_DEFAULT, "PyExc_KeyboardInterrupt");
  bool interrupted = py.PyErr_Occurred() && interrupt && py.PyErr_ExceptionMatches(*interrupt);
  if (py.PyErr_Occurred()) py.PyErr_Clear();
  if (interrupted) py.PyErr_SetInterrupt();  // it is the node's
  if (result) py.Py_DecRef(result);
  if (code) py.Py_DecRef(code);
  py.Py_DecRef(globals);
  return is_rclpy;
}

// Called at each `rcl_init`. Several interpreters and libraries of one process may call it: the first
// that has rclpy counts.
static void meet_python(void) {
  static _Atomic bool met;
  const char *wish = getenv("CHAINSHAPER_RCLPY");
  if (met || !memory || (wish && !strcmp(wish, "inferred"))) return;
  if (!find_python()) return;  // no Python, as in nearly all processes of C++
  void *thread_of_python = py.PyGILState_GetThisThreadState();
  if (!thread_of_python || thread_of_python != py.current_thread() || py.PyErr_Occurred()) return;
  met = true;  // also while the hook runs
  met = run_hook();
}
