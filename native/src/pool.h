// A persistent thread pool behind one function: parallel_for(threads, tasks, body).
//
// Tasks are handed out dynamically, so a result must not depend on which thread runs which task: write to places
// that belong to the task, and add partial sums up afterwards in task order. Then every thread count gives the
// same bits. A parallel_for inside a task runs serially on the thread that calls it.
#pragma once

namespace tgb {

using TaskFunction = void (*)(const void* context, int task);

// Calls function(context, task) once for each task in [0, tasks) on up to `threads` threads; returns when all are done.
void run_tasks(int threads, int tasks, TaskFunction function, const void* context);

// The same for a lambda `body(int task)`. No std::function: its instantiations would be shared between objects
// compiled for different instruction sets.
template <class Body>
inline void parallel_for(int threads, int tasks, const Body& body) {
  run_tasks(threads, tasks, [](const void* context, int task) { (*static_cast<const Body*>(context))(task); }, &body);
}

}  // namespace tgb
