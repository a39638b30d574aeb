// RTAB-Map's node in the wheel of depthai asks a device for its calibration. This answers from the
// file that CALIBRATION_JSON names. tools/bench/slam_peers.py compiles it, and has it loaded before
// depthai's own library.
#include <cstdlib>
#include <filesystem>
#include <optional>

namespace dai {
// as large as depthai's, or larger: only its address is used here
struct CalibrationHandler {
    alignas(16) char storage[8192];
    CalibrationHandler(std::filesystem::path, std::optional<bool>);
    CalibrationHandler(const CalibrationHandler&);
    ~CalibrationHandler();
};

struct DeviceBase {
    CalibrationHandler getCalibration();
};

CalibrationHandler DeviceBase::getCalibration() {
    return CalibrationHandler(std::filesystem::path(std::getenv("CALIBRATION_JSON")), std::nullopt);
}
}  // namespace dai
