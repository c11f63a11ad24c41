// Memory of the engine: 64-byte aligned, grow-only, uninitialised, on huge pages where the system offers them.
#pragma once
#include <cstddef>

namespace tgb {

// Frees `memory` and returns room for at least `count` items of `item_size`; sets `capacity`. Throws std::bad_alloc.
// (Not part of the template: a template would be compiled per instruction set and merged by the linker.)
void* reallocate(void* memory, size_t count, size_t item_size, size_t& capacity);
void release(void* memory);

// Fresh pages cost more than the work done in them (14-60 ms for 15 MB), so a buffer keeps what it once had.
template <class T>
class Buffer {
 public:
  Buffer() = default;
  Buffer(const Buffer&) = delete;
  Buffer& operator=(const Buffer&) = delete;
  ~Buffer() { release(data_); }

  // Memory for at least `count` items; the former contents are lost when it has to grow.
  __attribute__((always_inline)) T* need(size_t count) {
    if (count > capacity_) {
      void* old = data_;
      data_ = nullptr;
      data_ = static_cast<T*>(reallocate(old, count, sizeof(T), capacity_));
    }
    return data_;
  }
  __attribute__((always_inline)) T* data() const { return data_; }
  __attribute__((always_inline)) T& operator[](size_t index) const { return data_[index]; }
  void swap(Buffer& other) {
    T* data = data_;
    const size_t capacity = capacity_;
    data_ = other.data_, capacity_ = other.capacity_;
    other.data_ = data, other.capacity_ = capacity;
  }

 private:
  T* data_ = nullptr;
  size_t capacity_ = 0;
};

}  // namespace tgb
