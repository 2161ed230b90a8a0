// Memory that is kept from frame to frame: it grows to what the largest frame needed, and nothing is allocated after that.
#pragma once
#include <cstddef>
#include <memory>

#include "pages.h"

namespace cap4d {

template <class T>
using Buffer = std::unique_ptr<T[]>;

template <class T>
Buffer<T> make_buffer(std::size_t n) {  // not initialised
  return std::make_unique_for_overwrite<T[]>(n ? n : 1);
}

template <class T>
class Scratch {
 public:
  // Room for n items, uninitialised; what was there is gone when it grows.
  T* reserve(std::size_t n) {
    if (n > capacity_ || !data_) {
      data_.reset();
      capacity_ = n + n / 8;
      data_ = make_pages<T>(capacity_);
    }
    return data_.get();
  }
  T* get() const { return data_.get(); }
  T& operator[](std::size_t i) const { return data_[i]; }
  std::size_t bytes() const { return capacity_ * sizeof(T); }

 private:
  Pages<T> data_;
  std::size_t capacity_ = 0;
};

}  // namespace cap4d
