// No exception leaves a library through its C interface: it becomes a fault of the calling thread, which Python raises.
#pragma once
#include <cstdint>
#include <cstring>
#include <exception>
#include <mutex>
#include <new>
#include <stdexcept>

namespace guard {

enum Kind : int32_t { none = 0, memory = 1, other = 2 };

struct Fault {
  int32_t kind = none;
  char text[200] = "";

  void note(Kind which, const char* what) noexcept {
    kind = which;
    std::strncpy(text, what, sizeof text - 1);
  }
};

inline Fault& last() noexcept {
  static thread_local Fault one;
  return one;
}

// Every entry runs its work in here; what it returns after a fault is 0 and means nothing.
template <class Call>
auto call(Call&& work) noexcept -> decltype(work()) {
  using Result = decltype(work());
  try {
    return work();
  } catch (const std::bad_alloc&) {
    last().note(memory, "");
  } catch (const std::length_error&) {  // more than a vector can hold
    last().note(memory, "");
  } catch (const std::exception& fault) {
    last().note(other, fault.what());
  } catch (...) {
    last().note(other, "an exception of no known type");
  }
  return Result();
}

// The kind of the last fault, and its text where there is room for it; which forgets it.
inline int32_t read(char* text, int64_t room) noexcept {
  Fault& fault = last();
  const int32_t kind = fault.kind;
  if (text && room > 0) {
    std::strncpy(text, fault.text, size_t(room) - 1);
    text[room - 1] = 0;
    fault = Fault();
  }
  return kind;
}

// Takes the first exception in a parallel region past the region's end, which none may cross on its own.
class Rescue {
 public:
  // Whether the work was done.
  template <class Work>
  bool run(Work&& work) noexcept {
    try {
      work();
      return true;
    } catch (...) {
      const std::lock_guard<std::mutex> alone(mutex_);
      if (!first_) first_ = std::current_exception();
      return false;
    }
  }
  // After the region, by the thread that began it.
  void rethrow() const {
    if (first_) std::rethrow_exception(first_);
  }

 private:
  std::mutex mutex_;
  std::exception_ptr first_;
};

}  // namespace guard
