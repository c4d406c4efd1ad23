// The guard that torch's autograd asks for the pretended device; torch's own for Python ends the process in the backward pass.
#include <c10/core/impl/DeviceGuardImplInterface.h>

namespace {

using NoOp = c10::impl::NoOpDeviceGuardImpl<c10::DeviceType::PrivateUse1>;

struct Guard final : NoOp {
  static c10::Device device() { return c10::Device(c10::DeviceType::PrivateUse1, 0); }
  static c10::Stream stream() { return c10::Stream(c10::Stream::DEFAULT, device()); }
  c10::Device getDevice() const override { return device(); }
  c10::Device exchangeDevice(c10::Device) const override { return device(); }
  c10::Stream getStream(c10::Device) const noexcept override { return stream(); }
  c10::Stream exchangeStream(c10::Stream) const noexcept override { return stream(); }
};

C10_REGISTER_GUARD_IMPL(PrivateUse1, Guard);

}  // namespace
